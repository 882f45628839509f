"""Which simulations have gone wrong, and why: checked after every control step, for every environment.

MuJoCo itself goes on with numbers that are not finite, and says so only in a counter.
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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
_MOVED = slice(_COLUMNS["root_pos"].start, _COLUMNS["joint_vel"].stop)
"""Positions and velocities."""
_VELOCITIES = (slice(_COLUMNS["root_lin_vel_w"].start, _COLUMNS["base_ang_vel_b"].stop), _COLUMNS["joint_vel"])
_CODE = {cause: code for code, cause in enumerate(CAUSES, start=1)}


def _ignore(message: str) -> None:
    """Take MuJoCo's warnings, which it would write to MUJOCO_LOG.TXT where the user works; they are counted here."""


mujoco.set_mju_user_warning(_ignore)


def diagnose(rows: Tensor, advanced: Tensor, warned: Tensor, wild: Tensor) -> Tensor:
    """Judge environments after a control step.

    Args:
        rows: staging rows in double precision, of which positions and velocities count, shape (n, 77 or more).
        advanced: whether the clock advanced, bool, shape (n,).
        warned: whether MuJoCo warned or refused, bool, shape (n,).
        wild: whether the action was absurd, bool, shape (n,).

    Returns:
        Code of the first cause that applies (``action`` before the others, then in order), 0 if none; int64, (n,).
    """
    size = rows[:, _MOVED].abs()
    speed = torch.stack([size[:, columns].amax(dim=1) for columns in _VELOCITIES]).amax(dim=0)
    signs = {
        "action": wild,
        "non_finite": ~(size.amax(dim=1) <= torch.finfo(rows.dtype).max),  # nothing is, that is not a number
        "velocity": speed > MAX_SPEED,
        "height": size[:, 2] > MAX_HEIGHT,
        "distance": size[:, :2].amax(dim=1) > MAX_DISTANCE,
        "time": ~advanced,
        "solver": warned,
    }
    codes = torch.zeros_like(wild, dtype=torch.long)
    for cause, applies in reversed(signs.items()):
        codes = codes.masked_fill(applies, _CODE[cause])
    return codes


class FlightRecorder:
    """What MuJoCo wrote of every environment of a pool in the last few steps, overwritten in turn."""

    LENGTH = 8

    def __init__(self, num_envs: int, width: int, pin_memory: bool = False) -> None:
        """Start empty; memory from which a GPU reads is pinned."""
        self._tensors = torch.zeros(self.LENGTH, num_envs, width, dtype=torch.float64, pin_memory=pin_memory)
        self._rows: Array = self._tensors.numpy()
        self._age = np.zeros(num_envs, dtype=np.int64)
        self._latest = 0

    @property
    def latest(self) -> Array:
        """Rows as they are now, shape (num_envs, width)."""
        return self._rows[self._latest]

    @property
    def tensor(self) -> Tensor:
        """The same rows, in the same memory."""
        return self._tensors[self._latest]

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
