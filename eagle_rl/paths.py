"""Where the data folders ``cfg`` and ``assets`` are, in a source checkout and in an installed package."""

from __future__ import annotations

from functools import cache
from pathlib import Path


@cache
def data_root() -> Path:
    """Return the folder that holds ``cfg/`` and ``assets/``.

    In a source checkout it is the repository; an installed wheel carries both folders inside the package.
    """
    package = Path(__file__).resolve().parent
    for root in (package.parent, package / "data"):
        if (root / "cfg" / "robots").is_dir():
            return root
    raise FileNotFoundError(f"cfg/robots is neither in {package.parent} nor in {package / 'data'}: reinstall eagle")
