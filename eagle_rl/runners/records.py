"""What a run's folder says about its stages: written atomically, read by resume, ``eagle status`` and plots.

``plan.json`` holds the planned stages, ``stages/NAME/stage.json`` the record of each.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from eagle_rl.config.yaml_file import write_yaml
from eagle_rl.errors import CheckpointError, ConfigError
from eagle_rl.paths import RUNS, misplaced
from eagle_rl.runners.checkpoint import verify_checkpoint
from eagle_rl.runners.files import write_atomically
from eagle_rl.runners.plan import Stage
from eagle_rl.runners.provenance import CONFIG, Provenance

State = Literal["pending", "training", "judging", "done"]


@dataclass(frozen=True, kw_only=True)
class Record:
    """How far a stage is and what it has cost."""

    state: State = "pending"
    inputs: Mapping[str, str] = field(default_factory=dict)
    """sha256 of the final checkpoint of every input stage."""
    env_steps: int = 0
    wall_seconds: float = 0.0
    checkpoint: str | None = None
    """Final checkpoint, relative to the run's folder."""
    sha256: str | None = None
    score: float | None = None
    """Pooled tracking score; lower is better, 1 is standing still."""


def stage_dir(run_dir: Path, stage: str) -> Path:
    """Folder of a stage."""
    return run_dir / "stages" / stage


def write_record(run_dir: Path, stage: str, record: Record) -> None:
    """Store a stage's record."""
    folder = stage_dir(run_dir, stage)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "stage.json", json.dumps(dataclasses.asdict(record), indent=1).encode())


def read_record(run_dir: Path, stage: str) -> Record:
    """A stage's record; a pending one where nothing was written yet."""
    path = stage_dir(run_dir, stage) / "stage.json"
    if not path.exists():
        return Record()
    with _damage_in_words(path):
        return Record(**json.loads(path.read_text(encoding="utf-8")))


def final_checkpoint(run_dir: Path, stage: str) -> Path:
    """Final checkpoint of a stage that is done, its content checked."""
    record = read_record(run_dir, stage)
    if record.state != "done" or record.checkpoint is None:
        raise CheckpointError(f"{run_dir}: stage {stage} is not done, so it has no final checkpoint.")
    path = run_dir / record.checkpoint
    if verify_checkpoint(path)["sha256"] != record.sha256:
        raise CheckpointError(f"{path}: is not the checkpoint the stage {stage} ended with (sha256 {record.sha256}).")
    return path


def open_plan(
    run_dir: Path, provenance: Provenance, stages: Sequence[Stage], *, resume: bool, allow_drift: bool = False
) -> Provenance:
    """Write the plan of a new run, or check that a resumed run is the one that was begun.

    A run that has drifted takes its new values over, so that it is resumed with them from then on.

    Args:
        run_dir: the run's folder.
        provenance: what the run depends on, its configuration included.
        stages: the planned stages.
        resume: whether the folder is expected to hold this run already.
        allow_drift: go on although something has changed.

    Returns:
        The provenance, marked if the run has ever drifted.
    """
    path = run_dir / "plan.json"
    if path.exists() or resume:
        if not resume:
            raise ConfigError(f"{run_dir}: holds a run already. Continue it with --resume, or choose another --out.")
        with _damage_in_words(path):
            begun = _read_plan_file(run_dir)["provenance"]
            changes = provenance.differences(begun)
            provenance = dataclasses.replace(provenance, drifted=begun["drifted"] or bool(changes))
        if changes and not allow_drift:
            raise ConfigError([f"{run_dir}: changed since the run was begun; undo it or use --allow-drift.", *changes])
        if not changes:
            return provenance
        values = provenance.as_manifest()["config"]  # before the plan, against which a resumed run is checked
        write_atomically(run_dir / CONFIG, write_yaml(values).encode())
    run_dir.mkdir(parents=True, exist_ok=True)
    plan = {"provenance": provenance.as_manifest(), "stages": [dataclasses.asdict(stage) for stage in stages]}
    write_atomically(path, json.dumps(plan, indent=1).encode())
    return provenance


@contextlib.contextmanager
def _damage_in_words(path: Path) -> Iterator[None]:
    """Say which file it was whose content is not what was written."""
    try:
        yield
    except CheckpointError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{path}: damaged: it does not hold what a run writes there.") from error


def _read_plan_file(run_dir: Path) -> dict[str, Any]:
    path = run_dir / "plan.json"
    if not path.exists():
        raise CheckpointError(misplaced(run_dir, "not a run directory: it has no plan.json.", *RUNS))
    return json.loads(path.read_text(encoding="utf-8"))


def read_plan(run_dir: Path) -> list[Stage]:
    """The planned stages of a run."""
    with _damage_in_words(run_dir / "plan.json"):
        stages = _read_plan_file(run_dir)["stages"]
        return [Stage(**{**s, "robots": tuple(s["robots"]), "teachers": tuple(s["teachers"])}) for s in stages]


def read_tolerance(run_dir: Path) -> float:
    """The gain under which a run's rounds stop."""
    with _damage_in_words(run_dir / "plan.json"):
        return float(_read_plan_file(run_dir)["provenance"]["config"]["plan"]["tolerance"])


def converged_round(stages: Sequence[Stage], records: Mapping[str, Record], tolerance: float) -> int | None:
    """First round whose distillation improved the pooled score by less than ``tolerance``, or None so far."""
    scores = {s.round: records[s.name].score for s in stages if s.kind in ("root", "generalist", "distill", "average")}
    for number in sorted(scores):
        before, after = scores.get(number - 1), scores[number]
        if before is not None and after is not None and before - after < tolerance * before:
            return number
    return None


def active_stages(stages: Sequence[Stage], records: Mapping[str, Record], tolerance: float) -> list[Stage]:
    """The stages that are to run: all rounds up to convergence."""
    last = converged_round(stages, records, tolerance)
    return [s for s in stages if last is None or s.round <= last]
