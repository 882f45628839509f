"""Files that keep what an environment did before it went wrong: npz, without pickle."""

from __future__ import annotations

import contextlib
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from eagle_rl.errors import ConfigError

from ..robots.spec import Array

MAX_FILES = 20
"""Most fault files in one folder."""

_ARRAYS = ("time", "qpos", "qvel", "ctrl")


@dataclass(frozen=True, kw_only=True, eq=False)
class Fault:
    """The last states of a sick environment, one row per control step, the sick state last."""

    robot: str
    """Name of the robot."""
    robot_file: str
    """Path of the robot's YAML."""
    cause: str
    """One of ``envs.sim.health.CAUSES``."""
    env: int
    """Index among the robot's environments."""
    time: Array
    """Since the start of the episode [s], shape (k,)."""
    qpos: Array
    """Root position, quaternion (w, x, y, z), native joint angles, shape (k, nq)."""
    qvel: Array
    """Root linear velocity (world), angular velocity (body), joint velocities, shape (k, nv)."""
    ctrl: Array
    """Native PD targets [rad], shape (k, joints)."""

    def save(self, folder: Path) -> Path | None:
        """Write a file into ``folder`` and return its path; None if the folder is full or cannot be written to."""
        with contextlib.suppress(OSError):  # a full disk must not stop training
            folder.mkdir(parents=True, exist_ok=True)
            number = sum(1 for _ in folder.glob("*.npz"))
            if number < MAX_FILES:
                path = folder / f"{number:02d}_{self.robot}_{self.cause}.npz"
                np.savez(path, **asdict(self))
                return path
        return None


def load_fault(path: Path) -> Fault:
    """Read a file that :meth:`Fault.save` wrote; nothing in it is executed.

    Raises:
        ConfigError: it is no such file.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            words = {name: str(file[name]) for name in ("robot", "robot_file", "cause")}
            arrays = {name: np.asarray(file[name], dtype=np.float64) for name in _ARRAYS}
            env = int(file["env"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, MemoryError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{path}: not a fault file: {error}. Expected a file of a run's faults/ folder.") from error
    rows = len(arrays["time"]) if arrays["time"].ndim == 1 else 0
    if rows == 0 or any(x.shape[:1] != (rows,) or x.ndim != 2 for name, x in arrays.items() if name != "time"):
        shapes = {name: x.shape for name, x in arrays.items()}
        raise ConfigError(f"{path}: not a fault file: got shapes {shapes}, expected one row per control step in each.")
    return Fault(
        robot=words["robot"], robot_file=words["robot_file"], cause=words["cause"], env=env,
        time=arrays["time"], qpos=arrays["qpos"], qvel=arrays["qvel"], ctrl=arrays["ctrl"],
    )  # fmt: skip
