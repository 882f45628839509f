"""Run directories: ``logs/<experiment>/<YYYY-mm-dd_HH-MM-SS>_seed<N>/``, each explaining itself."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

from eagle_rl.config.load import load_experiment, to_yaml
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import CheckpointError, ConfigError
from eagle_rl.paths import RUNS, data_root, misplaced
from eagle_rl.runners.provenance import CONFIG, Provenance

_README = """\
{name}: {description}

config.yaml       every value of this run; eagle train {here}/config.yaml runs it again
provenance.json   versions, seed, commit, robots' files, command line; uncommitted.diff if there was one
plan.json         the stages of the run, and what it depends on
stages/           of each: record, checkpoints, evaluation, metrics.jsonl and the same numbers for TensorBoard

Watch the curves   tensorboard --logdir {here}
Progress           eagle status {here}
Continue           eagle train --resume {here}
See it move        eagle play {here}
Tracking errors    eagle evaluate {here}
"""


def create_run(cfg: ExperimentCfg, out: Path, provenance: Provenance) -> Path:
    """Make a new run directory and write what explains the run into it.

    Args:
        cfg: the resolved experiment.
        out: folder of all runs.
        provenance: what the run depends on.

    Raises:
        ConfigError: the folder cannot be written.
    """
    folder = out / cfg.name
    try:
        run_dir = _fresh(folder, f"{datetime.now():%Y-%m-%d_%H-%M-%S}_seed{cfg.seed}")
        readme = _README.format(name=cfg.name, description=cfg.description, here=run_dir)
        record = json.dumps(_record(cfg, provenance), indent=2)
        texts = {CONFIG: to_yaml(cfg), "provenance.json": record + "\n", "README.txt": readme}
        texts |= {"uncommitted.diff": diff} if (diff := _uncommitted()) else {}
        for name, text in texts.items():
            (run_dir / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"{folder}: no run directory can be made: {error.strerror}. Choose another with --out."
        ) from error
    return run_dir


def _fresh(folder: Path, name: str) -> Path:
    """A folder that did not exist before, even if two runs start in the same second."""
    folder.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        try:
            path = folder / (name if number == 1 else f"{name}_{number}")
            path.mkdir()
        except FileExistsError:
            number += 1
        else:
            return path


def _record(cfg: ExperimentCfg, provenance: Provenance) -> dict[str, Any]:
    """Who, what and when, for a reader; what a resumed run is checked against is in the plan."""
    manifest = provenance.as_manifest()
    kept = ("config_hash", "robot_hashes", "slot_table_hash", "versions", "git_commit")
    return {
        "created": datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": sys.argv,
        "seed": cfg.seed,
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
        **{key: manifest[key] for key in kept},
    }


def _uncommitted() -> str:
    """Changes of tracked files against the last commit, empty outside a repository."""
    command = ["git", "diff", "HEAD"]
    try:
        done = subprocess.run(command, cwd=data_root(), capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout


def open_run(run_dir: Path, overrides: list[str]) -> ExperimentCfg:
    """The configuration of an existing run with overrides on top.

    Raises:
        CheckpointError: the folder is no run.
        ConfigError: its configuration, or an override, is wrong.
    """
    path = run_dir / CONFIG
    if not path.is_file():
        raise CheckpointError(misplaced(run_dir, f"not a run directory: it has no {CONFIG}.", *RUNS))
    return load_experiment(str(path), overrides)
