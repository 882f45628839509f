"""Which simulations have gone wrong, and why: checked after every control step, for every environment.

MuJoCo itself goes on with numbers that are not finite, and says so only in a counter.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..robots.spec import Array
from .columns import staging_columns

CAUSES = ("non_finite", "velocity", "height", "distance", "time", "solver", "action")
"""What can be wrong with an environment; code c stands for ``CAUSES[c - 1]`` and 0 for nothing:

- ``non_finite``: NaN or infinity in positions or velocities;
- ``velocity``: a coordinate faster than ``MAX_SPEED``;
- ``height``, ``distance``: the root beyond ``MAX_HEIGHT`` or ``MAX_DISTANCE``;
- ``time``: the clock did not advance;
- ``solver``: MuJoCo warned, or refused to step;
- ``action``: the action was not finite or beyond ``MAX_ACTION``; the last target was held instead.
"""

MAX_SPEED = 300.0
"""[m/s, rad/s]; robots under random actions of size 100 stay below 80 (measured)."""
MAX_HEIGHT = 5.0
"""Of the root above or below the world's origin [m]."""
MAX_DISTANCE = 1000.0
"""Of the root from the world's origin along x or y [m]."""
MAX_ACTION = 1e6
"""[-]; smaller actions are clipped, larger ones come from a policy that has come apart."""

_COLUMNS = staging_columns(num_sensors=0)
_VELOCITIES = np.r_[_COLUMNS["root_lin_vel_w"], _COLUMNS["base_ang_vel_b"], _COLUMNS["joint_vel"]]
_BOUNDS = np.full(_COLUMNS["joint_vel"].stop, np.finfo(np.float64).max)
"""Largest magnitude of each position and velocity in a staging row, shape (77,)."""
_BOUNDS[_COLUMNS["root_pos"]] = (MAX_DISTANCE, MAX_DISTANCE, MAX_HEIGHT)
_BOUNDS[_VELOCITIES] = MAX_SPEED
_CODE = {cause: code for code, cause in enumerate(CAUSES, start=1)}


def _ignore(message: str) -> None:
    """Take MuJoCo's warnings, which it would write to MUJOCO_LOG.TXT where the user works; they are counted here."""


mujoco.set_mju_user_warning(_ignore)


def diagnose(
    rows: Array, advanced: NDArray[np.bool_], warned: NDArray[np.bool_], wild: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Judge environments after a control step.

    Args:
        rows: staging rows in double precision, of which positions and velocities count, shape (n, 77 or more).
        advanced: whether the clock advanced, shape (n,).
        warned: whether MuJoCo warned or refused, shape (n,).
        wild: whether the action was absurd, shape (n,).

    Returns:
        Code of the first cause that applies (``action`` before the others, then in order), 0 if none; shape (n,).
    """
    moved = rows[:, : len(_BOUNDS)]
    bounded = np.abs(moved) <= _BOUNDS  # nothing is, that is not finite
    if advanced.all() and not (warned | wild).any() and bounded.all():
        return np.zeros(len(rows), dtype=np.int64)
    signs = {
        "action": wild,
        "non_finite": ~np.isfinite(moved).all(axis=1),
        "velocity": ~bounded[:, _VELOCITIES].all(axis=1),
        "height": ~bounded[:, 2],
        "distance": ~bounded[:, :3].all(axis=1),
        "time": ~advanced,
        "solver": warned,
    }
    return np.select(list(signs.values()), [_CODE[cause] for cause in signs], 0)


class FlightRecorder:
    """What MuJoCo wrote of every environment of a pool in the last few steps, overwritten in turn."""

    LENGTH = 8

    def __init__(self, num_envs: int, width: int) -> None:
        """Start empty."""
        self._rows = np.zeros((self.LENGTH, num_envs, width))
        self._age = np.zeros(num_envs, dtype=np.int64)
        self._latest = 0

    @property
    def latest(self) -> Array:
        """Rows as they are now, shape (num_envs, width)."""
        return self._rows[self._latest]

    def next(self) -> Array:
        """Rows to be written in a new step: the oldest, which they replace, shape (num_envs, width)."""
        self._latest = (self._latest + 1) % self.LENGTH
        self._age += 1
        return self.latest

    def forget(self, envs: NDArray[np.int64] | slice) -> None:
        """Drop what was kept of some environments, which begin anew."""
        self._age[envs] = 0

    def last(self, env: int) -> Array:
        """Rows of the steps of one environment since it began, oldest first, shape (k, width), k at most ``LENGTH``."""
        count = min(self.LENGTH, int(self._age[env]))
        return self._rows[np.arange(self._latest - count + 1, self._latest + 1) % self.LENGTH, env]
