"""From what a user points at, a file or a folder, to a checkpoint."""

from __future__ import annotations

from pathlib import Path

from eagle_rl.errors import CheckpointError
from eagle_rl.paths import RUNS, misplaced
from eagle_rl.runners.checkpoint import latest_checkpoint
from eagle_rl.runners.published import SUFFIX
from eagle_rl.runners.records import read_plan, stage_dir


def find_checkpoint(path: Path) -> Path:
    """The checkpoint meant by a path.

    Args:
        path: a checkpoint's data file or manifest, or a published policy; a ``checkpoints`` folder or the folder of a
            stage, whose latest checkpoint is meant; or a run directory, whose most advanced generalist is.

    Raises:
        CheckpointError: there is none.
    """
    if path.suffix in (".pt", ".json", SUFFIX):
        published = path.with_suffix(SUFFIX)
        file = published if path.suffix == SUFFIX or published.exists() else path.with_suffix(".pt")
        if not (path.exists() or file.exists()):
            raise CheckpointError(misplaced(path, ""))
        return file
    folders = [path, path / "checkpoints"]
    if (path / "plan.json").exists():
        generalists = [stage.name for stage in read_plan(path) if not stage.specialised]
        folders = [stage_dir(path, name) / "checkpoints" for name in reversed(generalists)]
    for folder in folders:
        found = latest_checkpoint(folder)
        if found is not None:
            return found
    wrong = f"no checkpoint there. Name a model_<iteration>.pt, a NAME{SUFFIX}, a stage's folder, or a run."
    raise CheckpointError(misplaced(path, wrong, f"*{SUFFIX}", "*.pt", *RUNS))
