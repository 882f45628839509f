"""The resting pose: the default one, or one that follows the commanded posture with a lag."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.config.schema import ControlCfg, GaitCfg, SimCfg, TaskCfg
from eagle_rl.export import stepping
from envs.mdp.posture import BentPose, DefaultPose, cell, make_posture
from envs.pooling import pool_robots
from envs.robots.load import load_robot
from envs.robots.model import build_model
from envs.robots.posture import HEIGHTS, PITCHES, POSTURE_SLOTS, posture_table
from envs.robots.spec import FEET

DT = 0.02
SPECS = [load_robot("h1"), load_robot("n1")]
ROBOTS = pool_robots(SPECS, [2, 1], TaskCfg(), torch.device("cpu"), torch.float64)
DEFAULT = ROBOTS.default_joint_pos
NODES = torch.tensor(PITCHES, dtype=torch.float64)
STANDING = torch.full((3, 2), 0.25, dtype=torch.float64)


def posture(share=1.0, lag=0.5, gait_share=0.0):
    cfg = ControlCfg(posture_reference=share, posture_time_constant=lag, gait_reference=gait_share)
    return make_posture(cfg, GaitCfg(), SPECS, ROBOTS, DT)


def commands(height, pitch):
    return torch.tensor([[0.3, 0.1, 0.2, height, pitch]], dtype=torch.float64).expand(3, 5)


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=5))
def test_interpolation_is_exact_on_straight_lines_and_holds_beyond_the_ends(values):
    x = torch.tensor(values, dtype=torch.float64)
    below, share = cell(x, NODES)
    torch.testing.assert_close(torch.lerp(NODES[below], NODES[below + 1], share), x.clamp(NODES[0], NODES[-1]))
    for value, node, part in zip(values, below.tolist(), share.tolist(), strict=True):
        weights = np.zeros(len(PITCHES))
        weights[node : node + 2] = 1.0 - part, part
        np.testing.assert_allclose(stepping.hat_weights(value, np.array(PITCHES)), weights, atol=1e-12)


def test_the_paper_s_pose_is_the_default_one():
    pose = make_posture(ControlCfg(), GaitCfg(), SPECS, ROBOTS, DT)
    assert isinstance(pose, DefaultPose)
    assert torch.equal(pose.advance(commands(-0.2, 0.3), STANDING), DEFAULT)
    assert pose.state_dict() == {}


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_the_command_is_followed_with_a_first_order_lag(share):
    pose = posture(share, lag=0.5)
    assert isinstance(pose, BentPose)
    for _ in range(25):
        pose.advance(commands(-0.2, 0.3), STANDING)
    reached = 1.0 - math.exp(-25 * DT / 0.5)
    torch.testing.assert_close(pose.followed, reached * commands(-0.2, 0.3))
    settled = posture(1.0, lag=1e-6).advance(share * reached * commands(-0.2, 0.3), STANDING)
    torch.testing.assert_close(pose.advance(pose.followed, STANDING), settled)


def test_at_rest_the_legs_have_each_robot_s_bend_and_the_rest_is_untouched():
    pose = posture(lag=1e-3)
    offsets = pose.advance(commands(HEIGHTS[1], PITCHES[6]), STANDING) - DEFAULT
    legs = torch.tensor(POSTURE_SLOTS)
    for env, robot in enumerate(ROBOTS.robot_id.tolist()):
        expected = torch.tensor(posture_table(SPECS[robot])[1, 6])
        torch.testing.assert_close(offsets[env, legs], expected.expand(2, 3))
    others = torch.ones(32, dtype=torch.bool)
    others[legs.flatten()] = False
    assert not offsets[:, others].any()


def test_a_reset_begins_in_the_default_pose_and_touches_no_other_environment():
    pose = posture()
    pose.advance(commands(-0.2, 0.3), STANDING)
    before = pose.followed.clone()
    pose.reset(torch.tensor([1]))
    assert not pose.followed[1].any()
    assert torch.equal(pose.followed[[0, 2]], before[[0, 2]])


def test_a_restored_pose_goes_on_exactly():
    pose, other = posture(), posture()
    pose.advance(commands(-0.2, 0.3), STANDING)
    other.load_state_dict(pose.state_dict())
    assert torch.equal(pose.advance(commands(-0.1, 0.0), STANDING), other.advance(commands(-0.1, 0.0), STANDING))


ALL = [load_robot(name) for name in ("h1", "g1", "t1", "n1", "adam")]
STANCE_TIME = 0.5 / GaitCfg().frequency


def soles(spec, pose, velocity, time):
    """Where both soles are, (2, 3) [m], by MuJoCo, with the base where a constant velocity takes it in a time."""
    v_x, v_y, omega = velocity
    model = build_model(spec, SimCfg())
    data = mujoco.MjData(model)
    yaw = omega * time
    data.qpos[:2] = v_x * time, v_y * time
    data.qpos[3:7] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    data.qpos[7:] = spec.signs * pose[spec.slots]
    mujoco.mj_kinematics(model, data)
    feet = [data.body(spec.link_roles[f"{side}_foot"]) for side in FEET]
    return np.stack(
        [foot.xpos + foot.xmat.reshape(3, 3) @ sole for foot, sole in zip(feet, spec.sole_offsets, strict=True)]
    )


def stepping_pose(spec, command, phases):
    """Resting pose, canonical [rad] (32,), of a robot that follows a command without lag, at phases (left, right)."""
    robots = pool_robots([spec], [1], TaskCfg(), torch.device("cpu"), torch.float64)
    cfg = ControlCfg(posture_reference=1.0, gait_reference=1.0, posture_time_constant=1e-6)
    pose = make_posture(cfg, GaitCfg(), [spec], robots, DT)
    return pose.advance(torch.tensor([command]).double(), torch.tensor([phases]).double())[0].numpy()


@pytest.mark.parametrize("spec", ALL, ids=lambda spec: spec.name)
@pytest.mark.parametrize("velocity", [(0.4, 0.0, 0.0), (-0.4, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, 0.5)])
@pytest.mark.parametrize("foot", [0, 1])
def test_a_foot_in_stance_stays_where_it_is_under_a_base_that_moves_as_commanded(spec, velocity, foot):
    """To second order in the angle: 3 cm of 11 for legs of half a metre; H1 cannot roll its ankles."""
    places = []
    for share in (0.0, 0.5, 0.999):
        phases = [0.5 * share + 0.5 * (side != foot) for side in range(2)]
        pose = stepping_pose(spec, [*velocity, 0.0, 0.0], phases)
        places.append(soles(spec, pose, velocity, (share - 0.5) * STANCE_TIME)[foot])
    moved = np.abs(np.diff(places, axis=0))[:, :2].max()
    path = STANCE_TIME * max(np.hypot(*velocity[:2]), 0.2 * velocity[2])
    assert moved < 0.12 * path + 0.002, f"{spec.name} at {velocity}: a foot in stance slips {moved:.3f} m of {path:.3f}"


@pytest.mark.parametrize("spec", ALL, ids=lambda spec: spec.name)
def test_a_foot_in_swing_is_lifted_to_the_swing_height_and_the_other_one_is_not(spec):
    rest = soles(spec, stepping_pose(spec, [0.3, 0.0, 0.0, 0.0, 0.0], [0.25, 0.25]), (0.0, 0.0, 0.0), 0.0)[:, 2]
    for phases, lifted in (([0.75, 0.25], 0), ([0.25, 0.75], 1)):
        height = soles(spec, stepping_pose(spec, [0.3, 0.0, 0.0, 0.0, 0.0], phases), (0.0, 0.0, 0.0), 0.0)[:, 2] - rest
        assert height[lifted] == pytest.approx(spec.swing_height, abs=0.01), spec.name
        assert height[1 - lifted] == pytest.approx(0.0, abs=1e-6), spec.name


def test_who_stands_does_not_step():
    standing = stepping_pose(ALL[1], [0.0, 0.0, 0.0, -0.1, 0.2], [0.25, 0.25])
    bent = posture_table(ALL[1])[list(HEIGHTS).index(min(HEIGHTS, key=lambda h: abs(h + 0.1)))]
    pitch = int(np.argmin(np.abs(np.array(PITCHES) - 0.2)))
    default = pool_robots([ALL[1]], [1], TaskCfg(), torch.device("cpu"), torch.float64).default_joint_pos[0]
    moved = standing - default.numpy()
    for side in POSTURE_SLOTS:
        np.testing.assert_allclose(moved[list(side)], bent[pitch], atol=1e-9)
    assert np.count_nonzero(np.abs(moved) > 1e-9) <= 6
