"""The resting pose: the default one, or one that follows the commanded posture with a lag."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.config.schema import ControlCfg, TaskCfg
from eagle_rl.export import runtime
from envs.mdp.posture import BentPose, DefaultPose, cell, make_posture
from envs.pooling import pool_robots
from envs.robots.load import load_robot
from envs.robots.posture import HEIGHTS, PITCHES, POSTURE_SLOTS, posture_table

DT = 0.02
SPECS = [load_robot("h1"), load_robot("n1")]
ROBOTS = pool_robots(SPECS, [2, 1], TaskCfg(), torch.device("cpu"), torch.float64)
DEFAULT = ROBOTS.default_joint_pos
NODES = torch.tensor(PITCHES, dtype=torch.float64)


def posture(share=1.0, lag=0.5):
    cfg = ControlCfg(posture_reference=share, posture_time_constant=lag)
    return make_posture(cfg, SPECS, ROBOTS, DT)


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
        np.testing.assert_allclose(runtime.hat_weights(value, np.array(PITCHES)), weights, atol=1e-12)


def test_the_paper_s_pose_is_the_default_one():
    pose = make_posture(ControlCfg(), SPECS, ROBOTS, DT)
    assert isinstance(pose, DefaultPose)
    assert torch.equal(pose.advance(commands(-0.2, 0.3)), DEFAULT)
    assert pose.state_dict() == {}


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_the_command_is_followed_with_a_first_order_lag(share):
    pose = posture(share, lag=0.5)
    assert isinstance(pose, BentPose)
    for _ in range(25):
        pose.advance(commands(-0.2, 0.3))
    reached = 1.0 - math.exp(-25 * DT / 0.5)
    torch.testing.assert_close(pose.followed, reached * commands(-0.2, 0.3)[:, 3:])
    settled = posture(1.0, lag=1e-6).advance(share * reached * commands(-0.2, 0.3))
    torch.testing.assert_close(pose.advance(reached * commands(-0.2, 0.3)), settled)


def test_at_rest_the_legs_have_each_robot_s_bend_and_the_rest_is_untouched():
    pose = posture(lag=1e-3)
    offsets = pose.advance(commands(HEIGHTS[1], PITCHES[6])) - DEFAULT
    legs = torch.tensor(POSTURE_SLOTS)
    for env, robot in enumerate(ROBOTS.robot_id.tolist()):
        expected = torch.tensor(posture_table(SPECS[robot])[1, 6])
        torch.testing.assert_close(offsets[env, legs], expected.expand(2, 3))
    others = torch.ones(32, dtype=torch.bool)
    others[legs.flatten()] = False
    assert not offsets[:, others].any()


def test_a_reset_begins_in_the_default_pose_and_touches_no_other_environment():
    pose = posture()
    pose.advance(commands(-0.2, 0.3))
    before = pose.followed.clone()
    pose.reset(torch.tensor([1]))
    assert not pose.followed[1].any()
    assert torch.equal(pose.followed[[0, 2]], before[[0, 2]])


def test_a_restored_pose_goes_on_exactly():
    pose, other = posture(), posture()
    pose.advance(commands(-0.2, 0.3))
    other.load_state_dict(pose.state_dict())
    assert torch.equal(pose.advance(commands(-0.1, 0.0)), other.advance(commands(-0.1, 0.0)))
