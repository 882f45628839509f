from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.config.schema import ControlCfg, GaitCfg, TaskCfg
from eagle_rl.errors import ConfigError
from envs.pooling import REFERENCE_LEG, action_scale, gait_frequency, pool_robots, share, soft_limits
from envs.robots.posture import leg_length
from envs.robots.slots import MIRROR_PERMUTATION, MIRROR_SIGN, SLOT_INDEX
from tests.envs.worlds import robot

ROBOTS = ("h1", "g1", "t1", "n1", "adam")


@given(st.integers(1, 10_000), st.integers(1, 12))
def test_shares_are_equal_up_to_a_remainder_on_the_first_robots(num_envs: int, num_robots: int) -> None:
    if num_envs < num_robots:
        with pytest.raises(ConfigError, match=f"num_envs: got {num_envs}.*{num_robots} robots"):
            share(num_envs, num_robots)
        return
    shares = share(num_envs, num_robots)
    assert sum(shares) == num_envs
    assert shares == sorted(shares, reverse=True)
    assert shares[0] - shares[-1] <= 1


@pytest.mark.parametrize("name", ROBOTS)
def test_an_action_of_one_follows_the_effort_rule(name: str) -> None:
    cfg, spec = ControlCfg(min_effort_ratio_shoulder_pitch=0.4), robot(name)
    scale = action_scale(spec, cfg)
    assert not scale[~spec.slot_mask].any(), "absent slots"
    for joint, slot in enumerate(spec.slots):
        role = next(n for n, i in SLOT_INDEX.items() if i == slot)
        leg_pitch = role.endswith(("hip_pitch", "knee_pitch", "ankle_pitch"))
        bound = 0.6 if leg_pitch else 0.4 if role.endswith("shoulder_pitch") else 0.25
        factor = 0.5 if role.endswith("hip_yaw") or slot >= 12 else 1.0
        expected = 0.25 * factor * min(1.0, max(bound, spec.effort_limit[joint] / spec.stiffness[joint]))
        assert scale[slot] == pytest.approx(expected), role


@pytest.mark.parametrize("name", ROBOTS)
def test_left_and_right_act_alike(name: str) -> None:
    scale = action_scale(robot(name), ControlCfg())
    assert np.allclose(scale, scale[MIRROR_PERMUTATION])


@pytest.mark.parametrize("name", ROBOTS)
def test_soft_limits_shrink_the_canonical_range_about_its_middle(name: str) -> None:
    spec = robot(name)
    hard, soft = soft_limits(spec, 1.0), soft_limits(spec, 0.9)
    native = np.sort(np.stack([spec.to_native(hard[0]), spec.to_native(hard[1])]), axis=0)
    assert np.allclose(native, [spec.joint_lower, spec.joint_upper])
    assert np.allclose(soft[0] + soft[1], hard[0] + hard[1])
    assert np.allclose(soft[1] - soft[0], 0.9 * (hard[1] - hard[0]))
    assert (hard[0] <= hard[1]).all()


def test_every_environment_has_the_constants_of_its_robot() -> None:
    specs = [robot("h1"), robot("t1")]
    robots = pool_robots(specs, [2, 1], TaskCfg(), torch.device("cpu"), torch.float64)
    assert robots.robot_id.tolist() == [0, 0, 1]
    for row, spec in enumerate([specs[0], specs[0], specs[1]]):
        assert robots.total_mass[row] == spec.total_mass
        assert robots.nominal_height[row] == spec.nominal_height
        assert np.array_equal(robots.slot_mask[row].numpy(), spec.slot_mask)
        assert np.allclose(spec.to_native(robots.default_joint_pos[row].numpy()), spec.default_joint_pos)
        mirrored = robots.default_joint_pos[row].numpy()[MIRROR_PERMUTATION] * MIRROR_SIGN
        assert np.allclose(robots.default_joint_pos[row].numpy(), mirrored), "the default pose is symmetric"


LEGS = {"h1": 0.87, "g1": 0.689, "t1": 0.572, "n1": 0.632, "adam": 0.895}
"""Thigh, shank and foot seen from the side, added up by hand from the vendors' joint origins and soles [m]."""


@pytest.mark.parametrize("name", LEGS)
def test_a_leg_is_as_long_as_its_links(name):
    assert leg_length(robot(name)) == pytest.approx(LEGS[name], abs=1e-3)


@pytest.mark.parametrize("name", LEGS)
def test_short_legs_step_quicker_at_an_equal_froude_number(name):
    spec = robot(name)
    assert gait_frequency(spec, GaitCfg(frequency=2.0)) == 2.0, "without scaling there is one clock for all"
    scaled = gait_frequency(spec, GaitCfg(frequency=2.0, leg_scaling=0.5))
    assert scaled**2 * leg_length(spec) == pytest.approx(2.0**2 * REFERENCE_LEG), "f^2 L / g differs between robots"
