"""What a run's folder says about its stages: written atomically, read by resume, by ``eagle status`` and by plots.

``plan.json`` holds the planned stages, ``stages/NAME/stage.json`` the record of each. No torch.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from eagle_rl.errors import CheckpointError, ConfigError
from eagle_rl.runners.plan import Stage

State = Literal["pending", "training", "judging", "done"]


@dataclass(frozen=True, kw_only=True)
class Record:
    """How far a stage is and what it has cost."""

    state: State = "pending"
    inputs: Mapping[str, str] = field(default_factory=dict)
    """sha256 of the final checkpoint of every input stage."""
    iteration: int = 0
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


def sha256_of(path: Path) -> str:
    """Content hash of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_text_atomically(path: Path, text: str) -> None:
    """Replace a file so that a reader, also after a crash, sees the old content or the new, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    with draft.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)


def write_record(run_dir: Path, stage: str, record: Record) -> None:
    """Store a stage's record."""
    write_text_atomically(stage_dir(run_dir, stage) / "stage.json", json.dumps(dataclasses.asdict(record), indent=1))


def read_record(run_dir: Path, stage: str) -> Record:
    """A stage's record; a pending one where nothing was written yet."""
    path = stage_dir(run_dir, stage) / "stage.json"
    if not path.exists():
        return Record()
    return Record(**json.loads(path.read_text(encoding="utf-8")))


def final_checkpoint(run_dir: Path, stage: str) -> Path:
    """Final checkpoint of a stage that is done, its content checked."""
    record = read_record(run_dir, stage)
    if record.state != "done" or record.checkpoint is None:
        raise CheckpointError(f"{run_dir}: stage {stage} is not done, so it has no final checkpoint.")
    path = run_dir / record.checkpoint
    found = sha256_of(path) if path.exists() else "no file"
    if found != record.sha256:
        raise CheckpointError(
            f"{path}: expected sha256 {record.sha256}, found {found}. Remove {stage} to train it again."
        )
    return path


def _plan_differences(planned: Any, asked: Any, path: str = "plan") -> Iterator[str]:
    """What differs between two plans as read from JSON, one line each."""
    if isinstance(planned, dict) and isinstance(asked, dict):
        for key in sorted(planned.keys() | asked.keys()):
            yield from _plan_differences(planned.get(key), asked.get(key), f"{path}.{key}")
    elif planned != asked:
        yield f"{path}: the run was begun with {planned!r}, now {asked!r}"


def open_plan(run_dir: Path, config: Mapping[str, Any], stages: Sequence[Stage], resume: bool) -> None:
    """Write the plan of a new run, or check that a resumed run is the one that was begun.

    Args:
        run_dir: the run's folder.
        config: the resolved experiment, as plain data.
        stages: the planned stages.
        resume: whether the folder is expected to hold this run already.
    """
    path = run_dir / "plan.json"
    text = json.dumps({"config": config, "stages": {s.name: dataclasses.asdict(s) for s in stages}}, indent=1)
    if not path.exists():
        write_text_atomically(path, text)
        return
    if not resume:
        raise ConfigError(
            f"{run_dir}: holds a run already. Continue it with --resume {run_dir}, or choose another --out."
        )
    differences = list(_plan_differences(json.loads(path.read_text(encoding="utf-8")), json.loads(text)))
    if differences:
        raise ConfigError([*differences, f"{run_dir}: resume with the settings it was begun with, or start a new run."])


def read_plan(run_dir: Path) -> list[Stage]:
    """The planned stages of a run."""
    path = run_dir / "plan.json"
    if not path.exists():
        raise ConfigError(f"{run_dir}: no plan.json, so this is no run of an experiment.")
    stages = json.loads(path.read_text(encoding="utf-8"))["stages"].values()
    return [Stage(**{**s, "robots": tuple(s["robots"]), "teachers": tuple(s["teachers"])}) for s in stages]


def converged_round(stages: Sequence[Stage], records: Mapping[str, Record], tolerance: float) -> int | None:
    """First round whose distillation improved the pooled score by less than ``tolerance``, or None so far."""
    scores = {s.round: records[s.name].score for s in stages if s.kind in ("root", "generalist", "distill")}
    for number in sorted(scores):
        before, after = scores.get(number - 1), scores[number]
        if before is not None and after is not None and before - after < tolerance * before:
            return number
    return None


def active_stages(stages: Sequence[Stage], records: Mapping[str, Record], tolerance: float) -> list[Stage]:
    """The stages that are to run: all rounds up to convergence."""
    last = converged_round(stages, records, tolerance)
    return [s for s in stages if last is None or s.round <= last]
