"""Which simulations have gone wrong, and why: checked after every control step, for every environment of a robot.

MuJoCo itself goes on with numbers that are not finite, and says so only in a counter.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

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

_ROOT_BOUND = np.array([MAX_DISTANCE, MAX_DISTANCE, MAX_HEIGHT])
_CODE = {cause: code for code, cause in enumerate(CAUSES, start=1)}


def _ignore(message: str) -> None:
    """Take MuJoCo's warnings, which it would write to MUJOCO_LOG.TXT where the user works; they are counted here."""


mujoco.set_mju_user_warning(_ignore)


def diagnose(
    qpos: Array,
    qvel: Array,
    advanced: NDArray[np.bool_],
    warned: NDArray[np.bool_],
    wild: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Judge simulations after a control step.

    Args:
        qpos: positions, root first, shape (n, nq).
        qvel: velocities, shape (n, nv).
        advanced: whether the clock advanced, shape (n,).
        warned: whether MuJoCo warned or refused, shape (n,).
        wild: whether the action was absurd, shape (n,).

    Returns:
        Code of the first cause that applies (``action`` before the others, then in order), 0 if none; shape (n,).
    """
    if advanced.all() and not (warned | wild).any() and _sound(qpos, qvel):
        return np.zeros(len(qpos), dtype=np.int64)
    finite = np.isfinite(qpos).all(axis=1) & np.isfinite(qvel).all(axis=1)
    signs = {
        "action": wild,
        "non_finite": ~finite,
        "velocity": ~(np.abs(qvel) <= MAX_SPEED).all(axis=1),
        "height": ~(np.abs(qpos[:, 2]) <= MAX_HEIGHT),
        "distance": ~(np.abs(qpos[:, :3]) <= _ROOT_BOUND).all(axis=1),
        "time": ~advanced,
        "solver": warned,
    }
    return np.select(list(signs.values()), [_CODE[cause] for cause in signs], 0)


def _sound(qpos: Array, qvel: Array) -> bool:
    """Whether all simulations are finite and within bounds, by whole-array sums and extremes: the usual case."""
    return bool(
        np.isfinite(qpos.sum())
        and qvel.max() <= MAX_SPEED
        and qvel.min() >= -MAX_SPEED
        and (np.abs(qpos[:, :3]) <= _ROOT_BOUND).all()
    )


class FlightRecorder:
    """The last few states of every simulation of a robot, overwritten in turn."""

    LENGTH = 8

    def __init__(self, num_envs: int, state_size: int) -> None:
        """Start empty."""
        self._states = np.zeros((self.LENGTH, num_envs, state_size))
        self._age = np.zeros(num_envs, dtype=np.int64)
        self._next = 0

    def add(self, states: Array) -> None:
        """Keep one state of every simulation, shape (n, state_size)."""
        self._states[self._next] = states
        self._next = (self._next + 1) % self.LENGTH
        self._age += 1

    def forget(self, ids: NDArray[np.int64] | slice) -> None:
        """Drop what was kept of some simulations, which begin anew."""
        self._age[ids] = 0

    def last(self, env: int) -> Array:
        """States of one simulation since it began, oldest first, shape (k, state_size), k at most ``LENGTH``."""
        count = min(self.LENGTH, int(self._age[env]))
        order = (self._next - count + np.arange(count)) % self.LENGTH
        return self._states[order, env]
