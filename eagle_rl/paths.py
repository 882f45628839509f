"""Where the data files are, ``cfg/``, ``assets/`` and ``checkpoints/``, and how paths are spoken of in messages."""

from __future__ import annotations

from pathlib import Path

from eagle_rl.errors import did_you_mean

_PACKAGE = Path(__file__).resolve().parent

RUNS = ("*/plan.json", "*/*/plan.json")
"""Patterns of the runs in a folder: the runs of one experiment, or those of all."""
_FEW = 4


def data_root() -> Path:
    """Folder that holds ``cfg/``, ``assets/`` and ``checkpoints/``.

    A wheel carries them inside the package; a checkout has them beside it, where they are meant to be edited.
    """
    packaged = _PACKAGE / "data"
    return packaged if packaged.is_dir() else _PACKAGE.parent


def shown(path: Path) -> str:
    """A path for messages: relative to the data root or to the working folder where it lies inside one of them."""
    absolute = path.resolve()
    for folder in (data_root(), Path.cwd()):
        if absolute.is_relative_to(folder):
            return str(absolute.relative_to(folder))
    return str(path)


def misplaced(path: Path, wrong: str, *patterns: str) -> str:
    """Why a path that a user named will not do: nothing is there, or what is there is ``wrong``.

    Args:
        path: what was named.
        wrong: what to say of it if it exists, whole sentences.
        patterns: of files that would have done and may lie in the folder named; the newest few are listed, a run by
            its folder.
    """
    if not path.exists():
        beside = path.parent.iterdir() if path.parent.is_dir() else ()
        nearest = did_you_mean(path.name, [entry.name for entry in beside if entry.suffix == path.suffix])
        return f"{path}: no such {'file' if path.suffix else 'folder'}.{nearest}"
    found = sorted((x for pattern in patterns for x in path.glob(pattern)), key=lambda x: x.stat().st_mtime)[::-1]
    names = [str(x.parent if x.name == "plan.json" else x) for x in found[:_FEW]]
    more = f" and {len(found) - _FEW} more" if len(found) > _FEW else ""
    return f"{path}: {wrong}" + (f" There, newest first: {', '.join(names)}{more}." if names else "")
