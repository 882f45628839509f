"""The pose that actions are added to: the default pose, or one that follows the commanded posture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from eagle_rl.config.schema import ControlCfg

from ..recording import Attributes
from ..robots.posture import HEIGHTS, PITCHES, POSTURE_SLOTS, posture_table
from ..robots.spec import RobotSpec
from ..state import PooledRobots


class RestingPose(Protocol):
    """Where the PD targets are while the actions are zero."""

    ATTRIBUTES: ClassVar[Attributes]
    """Paths, from the environment, of what :meth:`advance` reads and writes (``envs.recording``)."""

    def advance(self, command: Tensor) -> Tensor:
        """The pose of this control step under the commands (N, 5), canonical [rad], (N, 32)."""

    def reset(self, ids: Tensor) -> None:
        """Begin new episodes, shape (n,)."""

    def state_dict(self) -> dict[str, Tensor]:
        """What a resumed run needs."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""


def make_posture(cfg: ControlCfg, specs: Sequence[RobotSpec], robots: PooledRobots, step_dt: float) -> RestingPose:
    """The resting pose a task asks for.

    Args:
        cfg: whether it follows the commanded posture, and how fast.
        specs: the pool's robots.
        robots: constants of each environment's robot, an index into ``specs`` among them.
        step_dt: control step [s].
    """
    if cfg.posture_reference == 0.0:
        return DefaultPose(robots.default_joint_pos)
    return BentPose(cfg, specs, robots, step_dt)


def left_over(cfg: ControlCfg, step_dt: float) -> float:
    """Share of the way to the commanded posture that is left after a control step [-]."""
    return math.exp(-step_dt / cfg.posture_time_constant)


class DefaultPose:
    """The default pose, whatever is commanded (paper)."""

    ATTRIBUTES: ClassVar[Attributes] = (("posture._default",), ())

    def __init__(self, default: Tensor) -> None:
        """Rest in ``default``, canonical [rad], (N, 32)."""
        self._default = default

    def advance(self, command: Tensor) -> Tensor:
        """The default pose."""
        return self._default

    def reset(self, ids: Tensor) -> None:
        """Nothing to begin anew."""

    def state_dict(self) -> dict[str, Tensor]:
        """Nothing to keep."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Nothing to restore."""


class BentPose:
    """The default pose with the legs bent to the commanded height and pitch.

    A policy then walks about a bent pose instead of having to learn the kinematics of a squat. The command is followed
    with a lag of the first order, so that a new one is no blow to the joints.
    """

    ATTRIBUTES: ClassVar[Attributes] = (
        ("posture.followed", "posture._default", "posture._robot"),
        ("posture.followed",),
    )

    def __init__(self, cfg: ControlCfg, specs: Sequence[RobotSpec], robots: PooledRobots, step_dt: float) -> None:
        """Start in the default pose; see :func:`make_posture`."""
        default = robots.default_joint_pos
        self._default, self._robot = default, robots.robot_id
        self._share, self._left_over = cfg.posture_reference, left_over(cfg, step_dt)
        self._nodes = default.new_tensor(HEIGHTS), default.new_tensor(PITCHES)
        self._slots = torch.tensor(POSTURE_SLOTS, device=default.device).flatten()
        self._bends = default.new_tensor(np.stack([posture_table(spec) for spec in specs]))
        self.followed = default.new_zeros(len(default), 2)
        """Height offset [m] and pitch [rad], of which the legs take their share, shape (N, 2)."""

    def advance(self, command: Tensor) -> Tensor:
        """The pose of this control step under the commands (N, 5), canonical [rad], (N, 32)."""
        self.followed = torch.lerp(command[:, 3:], self.followed, self._left_over)
        height, pitch = (self._share * self.followed).unbind(1)
        return self._default.index_add(1, self._slots, self._bend(height, pitch).repeat(1, 2))

    def _bend(self, height: Tensor, pitch: Tensor) -> Tensor:
        """Offsets of either leg's joints interpolated at a height and pitch, (N,) each; canonical [rad], (N, 3).

        Without a matrix product, whose last bits depend on how many environments there are.
        """
        (row, down), (column, along) = (cell(x, nodes) for x, nodes in zip((height, pitch), self._nodes, strict=True))
        above, below = (
            torch.lerp(self._bends[self._robot, r, column], self._bends[self._robot, r, column + 1], along.unsqueeze(1))
            for r in (row, row + 1)
        )
        return torch.lerp(above, below, down.unsqueeze(1))

    def reset(self, ids: Tensor) -> None:
        """Back to the default pose, shape (n,)."""
        self.followed = self.followed.index_fill(0, ids, 0.0)

    def state_dict(self) -> dict[str, Tensor]:
        """What a resumed run needs."""
        return {"followed": self.followed.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.followed = state["followed"].to(self.followed, copy=True)


def cell(x: Tensor, nodes: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the node below and share of the way to the next, (N,) each, for evenly spaced nodes (n,); ends hold."""
    place = ((x - nodes[0]) / (nodes[1] - nodes[0])).clamp(0.0, len(nodes) - 1.0)
    below = place.floor().clamp(max=len(nodes) - 2.0)
    return below.long(), place - below
