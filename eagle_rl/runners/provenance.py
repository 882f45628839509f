"""What a checkpoint belongs to: configuration, robots, slot table, versions, ancestors."""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from typing import Any

CONFIG = "config.yaml"
"""File in a run's folder with every value of its experiment: for readers, and for ``--resume``."""

_DISTRIBUTIONS = ("torch", "rsl-rl-lib", "tensordict", "mujoco", "pin", "numpy")


def content_hash(value: Any) -> str:
    """Sha256 of a JSON-able value, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def slot_table_hash(slot_names: Sequence[str]) -> str:
    """Identity of a slot table: which slot means what."""
    return content_hash(list(slot_names))


@cache
def versions() -> dict[str, str]:
    """Versions of what decides the bits of a run."""
    found = {"python": platform.python_version()}
    for name in _DISTRIBUTIONS:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


@cache
def git_commit() -> str | None:
    """Commit of the working tree the code runs from, with ``-dirty`` if it has changes; None outside of git."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    folder = __file__.rsplit("/", 1)[0]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Identity of a stage of a run."""

    config: Mapping[str, Any] = field(default_factory=dict)
    """The resolved experiment as plain values."""
    robots: Mapping[str, str] = field(default_factory=dict)
    """Name of each robot, as its own file has it, to the hash of its files, in the order of ``config``'s robots."""
    slot_table_hash: str = ""
    stage: str = "train"
    """Path of the stage in its run, e.g. ``round1/specialist_h1``."""
    parents: Sequence[str] = ()
    """Sha256 of the checkpoints this stage started from or learns from."""
    drifted: bool = False
    """Whether the run went on although something it depends on had changed."""

    def name_of(self, robot: str) -> str:
        """What the file of a robot calls it that the configuration may name by the path of that file."""
        return dict(zip(self.config.get("robots", ()), self.robots, strict=False)).get(robot, robot)

    def as_manifest(self) -> dict[str, Any]:
        """Entries of a manifest, as JSON would return them."""
        config = json.loads(json.dumps(self.config))
        return {
            "config": config,
            "config_hash": content_hash(config),
            "robots": list(self.robots),
            "robot_hashes": dict(self.robots),
            "slot_table_hash": self.slot_table_hash,
            "stage": self.stage,
            "parents": list(self.parents),
            "drifted": self.drifted,
            "versions": versions(),
            "git_commit": git_commit(),
        }

    def differences(self, manifest: Mapping[str, Any]) -> list[str]:
        """What has changed since ``manifest`` was written, one line each; empty if a run can go on bit for bit."""
        now = self.as_manifest()
        keys = ("config", "robots", "robot_hashes", "slot_table_hash", "stage", "parents", "versions")
        return [line for key in keys for line in changes(key, manifest.get(key), now[key])]


def changes(name: str, old: Any, new: Any) -> list[str]:
    """Leaves that differ, as ``name.key: old -> new``."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = [*old, *(key for key in new if key not in old)]
        return [line for key in keys for line in changes(f"{name}.{key}", old.get(key), new.get(key))]
    return [] if old == new else [f"{name}: {old} -> {new}"]
