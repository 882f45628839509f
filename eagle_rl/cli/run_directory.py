"""Run directories: ``logs/<experiment>/<YYYY-mm-dd_HH-MM-SS>_seed<N>/``, each explaining itself."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Any

from eagle_rl.config.load import differences, load_experiment, to_yaml
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import CheckpointError, ConfigError

from .provenance import drift, git_diff

CONFIG = "config.yaml"
PROVENANCE = "provenance.json"

_README = """\
{name}: {description}

config.yaml       every value of this run; eagle train {here}/config.yaml runs it again
provenance.json   versions, seed, commit, robots' files, command line; uncommitted.diff if there was one
plan.json         the stages of the run and what each starts from
stages/           of each stage: stage.json (state, inputs, cost), checkpoints/, evaluation.json, and metrics.jsonl, one
                  line of numbers per iteration, with the same numbers for TensorBoard beside it

Watch the curves   tensorboard --logdir {here}
Progress           eagle status {here}
Continue           eagle train --resume {here}
See it move        eagle play {here}
Tracking errors    eagle evaluate {here}
"""


def create_run(cfg: ExperimentCfg, out: Path, record: dict[str, Any]) -> Path:
    """Make a new run directory and write what explains the run into it.

    Args:
        cfg: the resolved experiment.
        out: folder of all runs.
        record: the run's provenance.

    Raises:
        ConfigError: the folder cannot be written.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    folder = out / cfg.name
    try:
        run_dir = _fresh(folder, f"{stamp}_seed{cfg.seed}")
        (run_dir / CONFIG).write_text(to_yaml(cfg), encoding="utf-8")
        (run_dir / PROVENANCE).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        (run_dir / "README.txt").write_text(
            _README.format(name=cfg.name, description=cfg.description, here=run_dir), encoding="utf-8"
        )
        changes = git_diff()
        if changes:
            (run_dir / "uncommitted.diff").write_text(changes + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"{folder}: no run directory can be made: {error.strerror}. Choose another with --out."
        ) from error
    return run_dir


def _fresh(folder: Path, name: str) -> Path:
    """A folder that did not exist before, even if two runs start in the same second."""
    folder.mkdir(parents=True, exist_ok=True)
    for suffix in ("", *(f"_{i}" for i in range(2, 1000))):
        try:
            (folder / f"{name}{suffix}").mkdir()
        except FileExistsError:
            continue
        return folder / f"{name}{suffix}"
    raise FileExistsError(17, "a thousand runs started in one second")


def open_run(run_dir: Path, overrides: list[str]) -> tuple[ExperimentCfg, list[str]]:
    """The configuration of an existing run with overrides on top, and on which keys they change it.

    Raises:
        CheckpointError: the folder is no run.
        ConfigError: its configuration, or an override, is wrong.
    """
    path = run_dir / CONFIG
    if not path.is_file():
        raise CheckpointError(f"{run_dir}: not a run directory: it has no {CONFIG}.")
    saved = load_experiment(str(path))
    cfg = load_experiment(str(path), overrides)
    return cfg, differences(saved, cfg)


def check_drift(run_dir: Path, changes: list[str], record: dict[str, Any], allow: bool) -> None:
    """Refuse to resume a run under other conditions, or, if allowed, mark it as drifted.

    Raises:
        CheckpointError: something changed; lists it.
    """
    try:
        saved = json.loads((run_dir / PROVENANCE).read_text(encoding="utf-8"))
        changes = changes + drift(saved, record)
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        changes = [*changes, f"{PROVENANCE} is damaged or missing ({error})"]
    if not changes:
        return
    if not allow:
        listed = "\n  ".join(changes)
        raise CheckpointError(
            f"{run_dir}: this is no longer the run that was started, so it would not go on bit for bit:\n  {listed}\n"
            "Undo the change, or go on with --allow-drift, which marks the run."
        )
    with (run_dir / "drift.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps({"resumed": record["created"], "changes": changes}) + "\n")
