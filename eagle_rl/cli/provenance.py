"""Who, what and when of a run, and what has changed when it is taken up again."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from eagle_rl._version import __version__
from eagle_rl.paths import data_root

PACKAGES = ("torch", "rsl-rl-lib", "mujoco", "pin", "numpy", "tensordict", "gymnasium")
"""Packages whose version can change a run's numbers."""


def package_versions() -> dict[str, str]:
    """Version of eagle, Python and each package that can change a run's numbers."""
    own = {"eagle": __version__, "python": platform.python_version()}
    return own | {name: installed_version(name) for name in PACKAGES}


def installed_version(package: str) -> str:
    """Version of an installed package, or ``missing``."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _git(*arguments: str) -> str | None:
    """Output of a git command in the source tree, or None outside a repository."""
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=data_root(), capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip("\n")


def git_diff() -> str:
    """Uncommitted changes of tracked files, empty outside a repository."""
    return _git("diff", "HEAD") or ""


def provenance(seed: int, robot_files: dict[str, Iterable[Path]], config_hash: str) -> dict[str, Any]:
    """What a reader, or a resumed run, must know about how a run came to be.

    Args:
        seed: seed of the run.
        robot_files: files that define each robot.
        config_hash: hash of the resolved configuration.
    """
    return {
        "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "command": sys.argv,
        "seed": seed,
        "config_hash": config_hash,
        "versions": package_versions(),
        "robots": {name: {p.name: file_hash(p) for p in paths} for name, paths in robot_files.items()},
        "git_commit": _git("rev-parse", "HEAD"),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
    }


def drift(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """What makes a resumed run another run: each version and robot file that changed, as ``what: old -> new``."""
    lines = [
        f"{name}: {old['versions'].get(name, 'absent')} -> {value}"
        for name, value in new["versions"].items()
        if old["versions"].get(name) != value
    ]
    for robot, files in new["robots"].items():
        before = old["robots"].get(robot, {})
        lines += [f"robot {robot}: {name} changed" for name, digest in files.items() if before.get(name) != digest]
    return lines
