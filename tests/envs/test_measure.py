"""Frames and signs between physics and the pooled state, against MuJoCo's own rotations."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from envs.geometry import from_yaw_frame, heading_of, into_yaw_frame, quat_from_yaw, rotate_inverse
from envs.measure import measured
from envs.robots.sensors import NUM_SENSORS, SENSOR_SLICES
from envs.sim.columns import staging_columns
from tests.states import quaternion, quiet_state, random_robots

COLUMNS = staging_columns(NUM_SENSORS)


def staged(seed: int, rows: int = 16) -> Tensor:
    """Random staging rows with unit quaternions."""
    out = torch.randn(rows, COLUMNS["sensors"].stop, generator=torch.Generator().manual_seed(seed)).double()
    quat = COLUMNS["root_quat"]
    out[:, quat] = torch.nn.functional.normalize(out[:, quat], dim=1)
    return out


def turned_back(quat: Tensor, vector: Tensor) -> np.ndarray:
    """MuJoCo's rotation of one vector by the inverse of one quaternion."""
    conjugate, result = np.zeros(4), np.zeros(3)
    mujoco.mju_negQuat(conjugate, quat.numpy())
    mujoco.mju_rotVecQuat(result, vector.numpy(), conjugate)
    return result


def test_world_vectors_are_expressed_in_the_base_frame_as_mujoco_does():
    rows = staged(0)
    quat, vector = rows[:, COLUMNS["root_quat"]], rows[:, COLUMNS["root_lin_vel_w"]]
    expected = np.stack([turned_back(q, v) for q, v in zip(quat, vector, strict=True)])
    np.testing.assert_allclose(rotate_inverse(quat, vector), expected, atol=1e-12)
    fields = measured(rows, COLUMNS)
    np.testing.assert_allclose(fields["base_lin_vel_b"], expected, atol=1e-12)
    down = torch.tensor([0.0, 0.0, -1.0]).double()
    np.testing.assert_allclose(fields["projected_gravity_b"], [turned_back(q, down) for q in quat], atol=1e-12)


def test_other_quantities_are_the_staged_ones():
    rows = staged(1)
    fields = measured(rows, COLUMNS)
    for name in ("base_ang_vel_b", "joint_pos", "joint_vel", "joint_torque"):
        assert torch.equal(fields[name], rows[:, COLUMNS[name]]), name
    sensors = rows[:, COLUMNS["sensors"]]
    names = {"foot_pos_w": "sole_pos", "foot_vel_w": "sole_vel", "foot_force_w": "foot_force"}
    for name, sensor in names.items():
        assert torch.equal(fields[name].flatten(1), sensors[:, SENSOR_SLICES[sensor]]), name
    touching = sensors[:, SENSOR_SLICES["floor_contact"]] > 0
    assert torch.equal(fields["ground_contact"], touching.any(dim=1))


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_leaning_forward_is_positive_pitch_and_leaning_right_positive_roll(yaw):
    state = quiet_state(random_robots(0, num_envs=2))
    quats = torch.stack([quaternion(pitch=0.3, yaw=yaw), quaternion(roll=0.2, yaw=yaw)])
    gravity = rotate_inverse(quats, torch.tensor([0.0, 0.0, -1.0]).double().expand(2, 3))
    state = replace(state, root_quat_w=quats, projected_gravity_b=gravity)
    assert gravity[0, 0].item() == pytest.approx(math.sin(0.3))
    assert state.base_pitch.tolist() == pytest.approx([0.3, 0.0], abs=1e-12)
    assert state.base_roll.tolist() == pytest.approx([0.0, 0.2], abs=1e-12)


def test_the_yaw_frame_has_the_base_s_heading_and_leaves_the_vertical():
    yaw = torch.linspace(-3.0, 3.0, 13).double()
    heading = heading_of(torch.stack([quaternion(roll=0.1, pitch=0.4, yaw=a) for a in yaw.tolist()]))
    np.testing.assert_allclose(torch.atan2(heading[:, 1], heading[:, 0]), yaw, atol=1e-12)
    vector = torch.randn(13, 3, generator=torch.Generator().manual_seed(2)).double()
    np.testing.assert_allclose(into_yaw_frame(heading, vector), rotate_inverse(quat_from_yaw(yaw), vector), atol=1e-12)
    np.testing.assert_allclose(from_yaw_frame(heading, into_yaw_frame(heading, vector)), vector, atol=1e-12)
