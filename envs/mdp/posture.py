"""The pose that actions are added to: the default pose, or one that follows the commands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from eagle_rl.config.schema import ControlCfg, GaitCfg

from ..robots.posture import HEIGHTS, PITCHES
from ..robots.spec import Array, RobotSpec
from ..robots.stride import LEG_SLOTS, bend_table, stride_table
from ..state import PooledRobots
from .gait import stride, swing_target


class RestingPose(Protocol):
    """Where the PD targets are while the actions are zero."""

    def advance(self, command: Tensor, foot_phase: Tensor) -> Tensor:
        """The pose of this control step, canonical [rad], (N, 32).

        Args:
            command: (N, 5).
            foot_phase: of (left, right) at the end of the step [cycles], (N, 2).
        """

    def reset(self, ids: Tensor) -> None:
        """Begin new episodes, shape (n,)."""

    def state_dict(self) -> dict[str, Tensor]:
        """What a resumed run needs."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""


def make_posture(
    cfg: ControlCfg,
    gait: GaitCfg,
    specs: Sequence[RobotSpec],
    robots: PooledRobots,
    step_dt: float,
) -> RestingPose:
    """The resting pose a task asks for.

    Args:
        cfg: whether it follows the commands, and how fast.
        gait: when feet are to be in stance.
        specs: the pool's robots.
        robots: constants of each environment's robot, an index into ``specs`` among them.
        step_dt: control step [s].
    """
    if cfg.posture_reference == 0.0 and cfg.gait_reference == 0.0:
        return DefaultPose(robots.default_joint_pos)
    return BentPose(cfg, gait, specs, robots, step_dt)


def left_over(cfg: ControlCfg, step_dt: float) -> float:
    """Share of the way to the commanded posture that is left after a control step [-]."""
    return math.exp(-step_dt / cfg.posture_time_constant)


class DefaultPose:
    """The default pose, whatever is commanded (paper)."""

    def __init__(self, default: Tensor) -> None:
        """Rest in ``default``, canonical [rad], (N, 32)."""
        self._default = default

    def advance(self, command: Tensor, foot_phase: Tensor) -> Tensor:
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
    """The default pose with the legs bent to the commanded height and pitch, and stepping at the commanded velocity.

    A policy then walks about a bent pose instead of having to learn the kinematics of squats and steps. Commands are
    followed with a lag of the first order, so that a new one is no blow to the joints.
    """

    def __init__(
        self, cfg: ControlCfg, gait: GaitCfg, specs: Sequence[RobotSpec], robots: PooledRobots, step_dt: float
    ) -> None:
        """Start in the default pose; see :func:`make_posture`."""
        default = robots.default_joint_pos
        self._default, self._robot, self._swing_height = default, robots.robot_id, robots.swing_height
        self._gait, self._frequency = gait, robots.gait_frequency
        self._share, self._gait_share = cfg.posture_reference, cfg.gait_reference
        self._left_over = left_over(cfg, step_dt)
        self._nodes = default.new_tensor(HEIGHTS), default.new_tensor(PITCHES)
        self._slots = torch.tensor(LEG_SLOTS, device=default.device).flatten()
        self._bends = _by_robot(default, [bend_table(spec) for spec in specs])
        self._strides = _by_robot(default, [np.moveaxis(stride_table(spec), 0, 2) for spec in specs])
        self.followed = default.new_zeros(len(default), 5)
        """Command the legs are at, shape (N, 5)."""

    def advance(self, command: Tensor, foot_phase: Tensor) -> Tensor:
        """The pose of this control step, canonical [rad], (N, 32)."""
        self.followed = torch.lerp(command, self.followed, self._left_over)
        height, pitch = (self._share * self.followed[:, 3:]).unbind(1)
        if self._gait_share == 0.0:
            return self._default.index_add(1, self._slots, self._look_up(self._bends, height, pitch).repeat(1, 2))
        lift = self._gait_share * swing_target(foot_phase, self._swing_height, self._gait)
        bends = torch.stack([self._look_up(self._bends, height - lift[:, foot], pitch) for foot in range(2)], dim=1)
        moved = (
            self._gait_share * stride(foot_phase, self._frequency, self._gait).unsqueeze(2) * self.followed[:, None, :3]
        )
        strides = self._look_up(self._strides, height, pitch).unflatten(1, (2, 3, -1))
        legs = bends + (moved.unsqueeze(3) * strides).sum(dim=2)
        return self._default.index_add(1, self._slots, legs.flatten(1))

    def _look_up(self, table: Tensor, height: Tensor, pitch: Tensor) -> Tensor:
        """Each environment's row of a table, interpolated at a height and pitch, (N,) each; shape (N, columns).

        Without a matrix product, whose last bits depend on how many environments there are.
        """
        (row, down), (column, along) = (cell(x, nodes) for x, nodes in zip((height, pitch), self._nodes, strict=True))
        above, below = (
            torch.lerp(table[self._robot, r, column], table[self._robot, r, column + 1], along.unsqueeze(1))
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


def _by_robot(like: Tensor, tables: Sequence[Array]) -> Tensor:
    """One table (heights, pitches, ...) of each robot as (robots, heights, pitches, columns)."""
    return like.new_tensor(np.stack(tables)).flatten(3)


def cell(x: Tensor, nodes: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the node below and share of the way to the next, (N,) each, for evenly spaced nodes (n,); ends hold."""
    place = ((x - nodes[0]) / (nodes[1] - nodes[0])).clamp(0.0, len(nodes) - 1.0)
    below = place.floor().clamp(max=len(nodes) - 2.0)
    return below.long(), place - below
