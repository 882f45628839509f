"""The pooled state: what every robot did in the last control step, in slot space, and the constants it is judged by.

Rows are environments, robots one after another. Quantities end in ``_w`` (world frame) or ``_b`` (base frame, the root
link). Per-foot arrays are in the order left, right. Observations, rewards and terminations are pure functions of these.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import torch
from torch import Tensor
from typing_extensions import Self

from .geometry import heading_of


def carries(foot_force_w: Tensor) -> Tensor:
    """Whether feet carry more than 1 N, bool, shape (N, 2), by the force on each [N], shape (N, 2, 3)."""
    return foot_force_w[..., 2] > 1.0


@dataclass(kw_only=True)
class _Rows:
    """A dataclass of tensors that share their first dimension."""

    def rows(self, ids: Tensor) -> Self:
        """The same quantities of some environments, shape (n, ...)."""
        return type(self)(**{f.name: getattr(self, f.name)[ids] for f in fields(self)})


@dataclass(kw_only=True)
class PooledRobots(_Rows):
    """Constants of each environment's robot. Angles are canonical; absent slots hold zero."""

    robot_id: Tensor
    """Index into the run's robots, int64, shape (N,)."""
    slot_mask: Tensor
    """1 where the robot has a joint, float, shape (N, 32)."""
    default_joint_pos: Tensor
    """[rad], shape (N, 32)."""
    joint_soft_lower: Tensor
    """Lower soft limit, canonical [rad], shape (N, 32)."""
    joint_soft_upper: Tensor
    """[rad], shape (N, 32)."""
    action_scale: Tensor
    """Radians of target per unit action, shape (N, 32)."""
    nominal_height: Tensor
    """[m], shape (N,)."""
    swing_height: Tensor
    """[m], shape (N,)."""
    total_mass: Tensor
    """Nominal mass [kg], shape (N,)."""
    gait_frequency: Tensor
    """Steps of one foot per second [Hz], shape (N,)."""


@dataclass(kw_only=True)
class PooledState(_Rows):
    """State after a control step.

    What properties work out is kept: make a new state instead of changing the orientation or forces of an old one.
    """

    root_pos_w: Tensor
    """[m], shape (N, 3)."""
    root_quat_w: Tensor
    """(w, x, y, z), shape (N, 4)."""
    base_lin_vel_b: Tensor
    """[m/s], shape (N, 3)."""
    base_ang_vel_b: Tensor
    """[rad/s], shape (N, 3)."""
    projected_gravity_b: Tensor
    """Unit vector of gravity, shape (N, 3); upright is (0, 0, -1), leaning forward by p has x = +sin p."""
    base_height: Tensor
    """Root above the ground under it [m], shape (N,)."""
    joint_pos: Tensor
    """Canonical [rad], shape (N, 32)."""
    joint_vel: Tensor
    """Canonical [rad/s], shape (N, 32)."""
    joint_acc: Tensor
    """Difference of joint_vel over the control step [rad/s^2], shape (N, 32)."""
    joint_torque: Tensor
    """Torque of the last physics step, canonical sign [N m], shape (N, 32)."""
    foot_pos_w: Tensor
    """Sole centres [m], shape (N, 2, 3)."""
    foot_vel_w: Tensor
    """[m/s], shape (N, 2, 3)."""
    foot_force_w: Tensor
    """Force of the ground on each foot [N], shape (N, 2, 3)."""
    foot_height: Tensor
    """Sole centre above the ground under it [m], shape (N, 2)."""
    last_foot_contact: Tensor
    """Whether each foot carried more than 1 N one step ago, bool, shape (N, 2)."""
    link_force_w: Tensor
    """Net contact force on each of COLLISION_LINKS [N], shape (N, 7, 3)."""
    ground_contact: Tensor
    """Whether one of FALL_LINKS touches the ground, bool, shape (N,)."""
    height_scan: Tensor
    """Height of the ground at the scan points relative to the ground under the root [m], shape (N, P)."""
    friction: Tensor
    """Friction coefficient of the ground [-], shape (N,)."""
    command: Tensor
    """(v_x, v_y, omega, h, p), shape (N, 5)."""
    standing: Tensor
    """Whether all three velocity commands are zero, bool, shape (N,)."""
    foot_phase: Tensor
    """Gait phase of each foot in [0, 1), 0.25 while standing, shape (N, 2)."""
    actions: Tensor
    """a_t, shape (N, 32); zero in absent slots."""
    last_actions: Tensor
    """a_(t-1), shape (N, 32)."""
    last_last_actions: Tensor
    """a_(t-2), shape (N, 32)."""

    @cached_property
    def foot_contact(self) -> Tensor:
        """Whether each foot carries more than 1 N, bool, shape (N, 2)."""
        return carries(self.foot_force_w)

    @cached_property
    def base_pitch(self) -> Tensor:
        """Pitch, positive leaning forward: atan2(g_x, -g_z) [rad], shape (N,)."""
        return torch.atan2(self.projected_gravity_b[:, 0], -self.projected_gravity_b[:, 2])

    @cached_property
    def base_roll(self) -> Tensor:
        """Roll, positive leaning right: atan2(-g_y, -g_z) [rad], shape (N,)."""
        return torch.atan2(-self.projected_gravity_b[:, 1], -self.projected_gravity_b[:, 2])

    @cached_property
    def heading_w(self) -> Tensor:
        """(cos, sin) of the base's yaw, shape (N, 2)."""
        return heading_of(self.root_quat_w)
