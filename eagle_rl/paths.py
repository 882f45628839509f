"""Where the data files are: ``cfg/``, ``assets/`` and ``checkpoints/``, in a checkout and in an installed package."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


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
