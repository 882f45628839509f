"""What physics says after a control step, in the terms of the pooled state."""

from __future__ import annotations

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
    down = quat.new_tensor([0.0, 0.0, -1.0]).expand(len(quat), 3)

    def sensor(name: str, *shape: int) -> Tensor:
        return sensors[:, SENSOR_SLICES[name]].reshape(-1, *shape)

    return {
        "root_pos_w": staged[:, columns["root_pos"]],
        "root_quat_w": quat,
        "base_lin_vel_b": rotate_inverse(quat, staged[:, columns["root_lin_vel_w"]]),
        "base_ang_vel_b": staged[:, columns["base_ang_vel_b"]],
        "projected_gravity_b": rotate_inverse(quat, down),
        "joint_pos": staged[:, columns["joint_pos"]],
        "joint_vel": staged[:, columns["joint_vel"]],
        "joint_torque": staged[:, columns["joint_torque"]],
        "foot_pos_w": sensor("sole_pos", 2, 3),
        "foot_vel_w": sensor("sole_vel", 2, 3),
        "foot_force_w": sensor("foot_force", 2, 3),
        "link_force_w": sensor("contact_force", 7, 3),
        "ground_contact": sensor("floor_contact", 3).gt(0).any(dim=1),
    }
