"""What physics says after a control step, in the terms of the pooled state."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from .geometry import rotate_inverse
from .robots.sensors import SENSOR_SLICES


def measured(staged: Tensor, columns: dict[str, slice]) -> dict[str, Tensor]:
    """Fields of ``PooledState`` that follow from the staging rows alone.

    Args:
        staged: rows of ``PhysicsPool.step``, shape (n, columns).
        columns: see ``staging_columns``.
    """
    sensors = staged[:, columns["sensors"]]
    quat = staged[:, columns["root_quat"]]
    root_lin_vel_w = staged[:, columns["root_lin_vel_w"]]
    vectors = torch.stack((root_lin_vel_w, _down(quat.dtype, quat.device).expand_as(root_lin_vel_w)), dim=1)
    base_lin_vel_b, projected_gravity_b = rotate_inverse(quat.unsqueeze(1), vectors).unbind(1)

    def sensor(name: str, *shape: int) -> Tensor:
        return sensors[:, SENSOR_SLICES[name]].reshape(-1, *shape)

    return {
        "root_pos_w": staged[:, columns["root_pos"]],
        "root_quat_w": quat,
        "base_lin_vel_b": base_lin_vel_b,
        "base_ang_vel_b": staged[:, columns["base_ang_vel_b"]],
        "projected_gravity_b": projected_gravity_b,
        "joint_pos": staged[:, columns["joint_pos"]],
        "joint_vel": staged[:, columns["joint_vel"]],
        "joint_torque": staged[:, columns["joint_torque"]],
        "foot_pos_w": sensor("sole_pos", 2, 3),
        "foot_vel_w": sensor("sole_vel", 2, 3),
        "foot_force_w": sensor("foot_force", 2, 3),
        "link_force_w": sensor("contact_force", 7, 3),
        "ground_contact": sensor("floor_contact", 3).gt(0).any(dim=1),
    }


@lru_cache(maxsize=8)
def _down(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Direction of gravity in the world, shape (3,)."""
    return torch.tensor((0.0, 0.0, -1.0), dtype=dtype, device=device)
