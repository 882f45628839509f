"""Which simulations have gone wrong, and why: checked after every control step, for every environment.

MuJoCo itself goes on with numbers that are not finite, and says so only in a counter.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..robots.spec import Array

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

_CODE = {cause: code for code, cause in enumerate(CAUSES, start=1)}
_NONE = len(CAUSES) + 1.0


def _ignore(message: str) -> None:
    """Take MuJoCo's warnings, which it would write to MUJOCO_LOG.TXT where the user works; they are counted here."""


mujoco.set_mju_user_warning(_ignore)


def limits(columns: Mapping[str, slice], width: int, finite: float) -> tuple[Array, Array]:
    """What a robot's native rows, see ``RobotBatch.columns``, are judged by, shape (``width``,) each.

    Args:
        columns: where everything lies in them.
        width: so many columns are judged.
        finite: the largest number there is in their precision.

    Returns:
        Largest magnitude of each number of a simulation that is well, and the code of being beyond it.
    """
    largest, beyond = np.full(width, np.inf), np.zeros(width)

    def limit(where: slice, magnitude: float | tuple[float, ...], *causes: str) -> None:
        largest[where], beyond[where] = magnitude, [_CODE[cause] for cause in causes]

    for alarm in ("status", "warning"):
        limit(columns[alarm], 0.0, "solver")
    qpos = columns["qpos"].start
    limit(columns["qpos"], finite, "non_finite")
    limit(slice(qpos, qpos + 3), (MAX_DISTANCE, MAX_DISTANCE, MAX_HEIGHT), "distance", "distance", "height")
    limit(columns["qvel"], MAX_SPEED, "velocity")
    return largest, beyond


def diagnose(native: Tensor, largest: Tensor, beyond: Tensor, advanced: Tensor, wild: Tensor) -> Tensor:
    """Judge environments after a control step.

    Args:
        native: what MuJoCo wrote of each, shape (n, columns).
        largest: see :func:`limits`, shape (n, columns).
        beyond: see :func:`limits`, shape (n, columns).
        advanced: whether the clock advanced, bool, shape (n,).
        wild: whether the action was absurd, bool, shape (n,).

    Returns:
        Code of the first cause that applies (``action`` before the others, then in order), 0 if none; int64, (n,).
    """
    size = native.abs()
    beyond = torch.where(size <= torch.finfo(native.dtype).max, beyond, float(_CODE["non_finite"]))
    code = torch.where(size <= largest, _NONE, beyond).amin(dim=1)  # what is not a number is not within any limits
    code = torch.where(advanced, code, code.clamp(max=_CODE["time"]))
    return torch.where(wild, _CODE["action"], torch.where(code < _NONE, code, 0.0).long())


class FlightRecorder:
    """What MuJoCo wrote of every environment of a pool in the last few steps, overwritten in turn."""

    LENGTH = 8

    def __init__(self, num_envs: int, width: int, dtype: torch.dtype, pin_memory: bool = False) -> None:
        """Start empty; memory from which a GPU reads is pinned."""
        rows = torch.zeros(self.LENGTH, num_envs, width, dtype=dtype, pin_memory=pin_memory)
        self._tensors = rows.unbind()
        self._rows: Array = rows.numpy()
        self._began = np.zeros(num_envs, dtype=np.int64)
        self._steps = self._latest = 0

    @property
    def latest(self) -> Array:
        """Rows as they are now, shape (num_envs, width)."""
        return self._rows[self._latest]

    @property
    def tensor(self) -> Tensor:
        """The same rows, in the same memory."""
        return self._tensors[self._latest]

    @property
    def all(self) -> Array:
        """Rows of every step that is kept, shape (``LENGTH``, num_envs, width)."""
        return self._rows

    def next(self) -> int:
        """Which of ``all`` is to be written in a new step: the oldest."""
        self._steps += 1
        self._latest = self._steps % self.LENGTH
        return self._latest

    def forget(self, envs: NDArray[np.int64] | slice) -> None:
        """Drop what was kept of some environments, which begin anew."""
        self._began[envs] = self._steps

    def last(self, env: int) -> Array:
        """Where one environment began and its steps since, oldest first, shape (k, width), k at most ``LENGTH``."""
        count = min(self.LENGTH, self._steps - int(self._began[env]) + 1)
        return self._rows[np.arange(self._latest - count + 1, self._latest + 1) % self.LENGTH, env]
