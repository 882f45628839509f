"""The pose that actions are added to: the default pose, or one that follows the commanded posture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from eagle_rl.config.schema import ControlCfg

from ..robots.posture import HEIGHTS, PITCHES, POSTURE_SLOTS, posture_table
from ..robots.spec import RobotSpec


class RestingPose(Protocol):
    """Where the PD targets are while the actions are zero."""

    def advance(self, command: Tensor) -> Tensor:
        """The pose of this control step under the commands (N, 5), canonical [rad], (N, 32)."""

    def reset(self, ids: Tensor) -> None:
        """Begin new episodes, shape (n,)."""

    def state_dict(self) -> dict[str, Tensor]:
        """What a resumed run needs."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""


def make_posture(
    cfg: ControlCfg, robots: Sequence[RobotSpec], default: Tensor, robot_id: Tensor, step_dt: float
) -> RestingPose:
    """The resting pose a task asks for.

    Args:
        cfg: whether it follows the commanded posture, and how fast.
        robots: the pool's robots.
        default: default pose, canonical [rad], shape (N, 32).
        robot_id: index into ``robots``, shape (N,).
        step_dt: control step [s].
    """
    if cfg.posture_reference == 0.0:
        return DefaultPose(default)
    tables = default.new_tensor(np.stack([posture_table(spec) for spec in robots]))
    table = tables.flatten(1, 2)[robot_id]
    return BentPose(default, table, cfg.posture_reference, left_over(cfg, step_dt))


def left_over(cfg: ControlCfg, step_dt: float) -> float:
    """Share of the way to the commanded posture that is left after a control step [-]."""
    return math.exp(-step_dt / cfg.posture_time_constant)


class DefaultPose:
    """The default pose, whatever is commanded (paper)."""

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

    def __init__(self, default: Tensor, table: Tensor, share: float, left_over: float) -> None:
        """Start in the default pose.

        Args:
            default: canonical [rad], shape (N, 32).
            table: each environment's rows of ``posture_table``, shape (N, heights * pitches, 3).
            share: of the command that the pose takes over [-].
            left_over: share of the way to the command that is left after a control step [-].
        """
        self._default, self._table, self._share, self._left_over = default, table, share, left_over
        self._nodes = default.new_tensor(HEIGHTS), default.new_tensor(PITCHES)
        self._slots = torch.tensor(POSTURE_SLOTS, device=default.device)
        self.followed = default.new_zeros(len(default), 2)
        """Height offset [m] and pitch [rad] the legs are bent to, shape (N, 2)."""

    def advance(self, command: Tensor) -> Tensor:
        """The pose of this control step under the commands (N, 5), canonical [rad], (N, 32)."""
        self.followed = torch.lerp(self._share * command[:, 3:], self.followed, self._left_over)
        heights, pitches = map(hat_weights, self.followed.unbind(1), self._nodes)
        weights = (heights.unsqueeze(2) * pitches.unsqueeze(1)).flatten(1)
        bend = torch.einsum("nk,nkj->nj", weights, self._table)
        return self._default.index_add(1, self._slots.flatten(), torch.cat([bend, bend], dim=1))

    def reset(self, ids: Tensor) -> None:
        """Back to the default pose, shape (n,)."""
        self.followed = self.followed.index_fill(0, ids, 0.0)

    def state_dict(self) -> dict[str, Tensor]:
        """What a resumed run needs."""
        return {"followed": self.followed.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.followed = state["followed"].to(self.followed, copy=True)


def hat_weights(x: Tensor, nodes: Tensor) -> Tensor:
    """Weights (N, n) of linear interpolation between evenly spaced nodes (n,); beyond the ends the last one holds."""
    spacing = nodes[1] - nodes[0]
    inside = x.clamp(nodes[0], nodes[-1]).unsqueeze(1)
    return (1.0 - (inside - nodes).abs() / spacing).clamp(min=0.0)
