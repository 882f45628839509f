"""Tracking errors of the paper's main table, and what a robot that ignores its command would score."""

from __future__ import annotations

import torch
from torch import Tensor

from eagle_rl.config.schema import GaitCfg

from ..state import PooledRobots, PooledState
from .gait import homogenise

ERROR_NAMES = ("lin_vel_x", "lin_vel_y", "ang_vel_z", "base_height", "body_pitch")
"""Columns of every array of tracking errors: E_vx, E_vy, E_omega, E_h, E_p; also the fields of ``CommandsCfg``."""


def measured_commands(state: PooledState, robots: PooledRobots) -> Tensor:
    """What each command asks for, as it is, shape (N, 5): [m/s], [m/s], [rad/s], [m], [rad].

    Velocities are true ones in the base frame, height and pitch those of the root (HugWBC 10, 11.5).
    """
    return torch.stack(
        (
            state.base_lin_vel_b[:, 0],
            state.base_lin_vel_b[:, 1],
            state.base_ang_vel_b[:, 2],
            state.base_height - robots.nominal_height,
            state.base_pitch,
        ),
        dim=1,
    )


def tracking_errors(state: PooledState, robots: PooledRobots) -> Tensor:
    """Absolute error of each command, shape (N, 5): [m/s], [m/s], [rad/s], [m], [rad] (paper, Tab. main)."""
    return (state.command - measured_commands(state, robots)).abs()


def contact_match(state: PooledState, cfg: GaitCfg) -> Tensor:
    """Share of the feet whose contact agrees with the clock (stance, where C > 0.5), shape (N,)."""
    desired = homogenise(state.foot_phase, cfg.stance_ratio) < 0.5
    return (desired == state.foot_contact).to(state.foot_phase.dtype).mean(dim=1)
