from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from eagle_rl.config.schema import AidsCfg, ObservationsCfg
from envs.mdp.aids import LearningAids, harness_damping, harness_wrench
from envs.mdp.symmetry import mirror_state
from envs.state import PooledState
from tests.states import quaternion, quiet_state, random_robots, random_state

ROBOTS = random_robots(0)
N = len(ROBOTS.robot_id)
ONES = torch.ones(N, dtype=torch.float64)
WEIGHT = 9.81 * ROBOTS.total_mass
GOOD, BAD = torch.tensor([1.0, 1.0]), torch.tensor([0.0, 0.0])


def pull(state: PooledState, scale: Tensor = ONES) -> tuple[Tensor, Tensor]:
    force, torque = harness_wrench(state, ROBOTS, scale).split(3, dim=1)
    return force, torque


def tilted(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> PooledState:
    state = quiet_state(ROBOTS)
    gravity = [math.sin(pitch), -math.sin(roll) * math.cos(pitch), -math.cos(roll) * math.cos(pitch)]
    return replace(
        state,
        root_quat_w=quaternion(roll, pitch, yaw).expand(N, 4),
        projected_gravity_b=torch.tensor(gravity, dtype=torch.float64).expand(N, 3),
    )


def settled(episode_ratio: list[float], match: list[float]) -> LearningAids:
    """Aids after more updates than their running means remember."""
    aids = LearningAids(AidsCfg(), len(match))
    for _ in range(100):
        aids.update(torch.tensor(episode_ratio), torch.tensor(match))
    return aids


def test_harness_decays_only_while_episodes_are_long_and_feet_follow_the_clock() -> None:
    episode_ratio, match = [0.9, 0.9, 0.3], [0.75, 0.65, 0.9]
    aids = settled(episode_ratio, match)
    before = aids.harness.clone()
    aids.update(torch.tensor(episode_ratio), torch.tensor(match))
    assert (aids.harness / before).tolist() == pytest.approx([0.98, 1.0, 1.0])
    assert aids.harness[1:].tolist() == [1.0, 1.0], "never fulfilled"
    assert aids.log(["a", "b", "c"])["Curriculum/harness/a"] == aids.harness[0].item()


def test_harness_returns_to_a_robot_that_falls_but_never_beyond_its_start() -> None:
    cfg = AidsCfg()
    between = 0.5 * (cfg.min_episode_ratio + cfg.harness_return_ratio)
    aids = settled([0.9, 0.9], [0.9, 0.9])
    decayed = aids.harness.clone()
    for _ in range(20):
        aids.update(torch.tensor([0.0, between]), GOOD)
    assert decayed[0] < aids.harness[0] < cfg.harness, "the first falls"
    assert aids.harness[1] < decayed[1], "a robot between both thresholds keeps what is left"
    held = aids.harness[1].clone()
    aids.update(torch.tensor([0.0, between]), GOOD)
    assert aids.harness[1] == held
    for _ in range(500):
        aids.update(BAD, GOOD)
    assert aids.harness.tolist() == [cfg.harness, cfg.harness]


def test_gait_shaping_stays_until_its_robots_harness_is_exactly_zero() -> None:
    aids = LearningAids(AidsCfg(), 2)
    while aids.harness[0] > 0.0:
        assert aids.gait_shaping.tolist() == [1.0, 1.0]
        aids.update(torch.tensor([1.0, 0.0]), GOOD)
    for _ in range(10):
        aids.update(torch.tensor([1.0, 0.0]), GOOD)
    assert aids.gait_shaping[0] < 1.0
    assert aids.gait_shaping[1] == 1.0, "its harness is still on"


def test_gait_shaping_asks_for_better_contacts_than_the_harness() -> None:
    cfg = AidsCfg(harness=0.0)
    between = 0.5 * (cfg.harness_contact_match + cfg.min_contact_match)
    aids = LearningAids(cfg, 2)
    for _ in range(100):
        aids.update(GOOD, torch.tensor([between, 1.0]))
    assert aids.gait_shaping[0] == 1.0
    assert aids.gait_shaping[1] < 1.0


def test_one_lucky_interval_does_not_start_the_decay() -> None:
    aids = LearningAids(AidsCfg(), 2)
    aids.update(GOOD, GOOD)
    assert aids.harness.tolist() == aids.gait_shaping.tolist() == [1.0, 1.0]


def test_aids_end_at_exactly_zero_and_stay_there() -> None:
    aids = LearningAids(AidsCfg(), 2)
    for _ in range(1000):
        aids.update(GOOD, GOOD)
        assert ((aids.harness >= 0.01) | (aids.harness == 0.0)).all()
    assert aids.harness.tolist() == aids.gait_shaping.tolist() == [0.0, 0.0]
    aids.update(BAD, BAD)
    assert aids.harness.tolist() == [0.0, 0.0]


def test_aids_survive_saving() -> None:
    first, second = LearningAids(AidsCfg(), 2), LearningAids(AidsCfg(), 2)
    for _ in range(50):
        first.update(torch.tensor([1.0, 0.0]), GOOD)
    second.load_state_dict(first.state_dict())
    first.update(GOOD, BAD)
    second.update(GOOD, BAD)
    assert torch.equal(first.harness, second.harness)
    assert torch.equal(first.gait_shaping, second.gait_shaping)


def test_a_robot_that_does_as_told_is_only_carried_by_the_constant_share() -> None:
    force, torque = pull(quiet_state(ROBOTS))
    assert torch.allclose(force[:, 2], 0.35 * WEIGHT)
    assert not force[:, :2].any()
    assert not torque.any()


def test_scale_zero_is_exactly_zero_even_for_a_broken_state() -> None:
    state = random_state(1, ROBOTS)
    state.base_lin_vel_b[0] = float("nan")
    assert torch.equal(harness_wrench(state, ROBOTS, 0.0 * ONES), torch.zeros(N, 6, dtype=torch.float64))


def test_wrench_is_proportional_to_its_scale() -> None:
    state = random_state(2, ROBOTS)
    assert torch.allclose(harness_wrench(state, ROBOTS, 0.3 * ONES), 0.3 * harness_wrench(state, ROBOTS, ONES))


def test_torque_turns_the_robot_upright_in_the_world_frame() -> None:
    """Leaning right while heading along +y: the restoring torque is about -y."""
    _, torque = pull(tilted(roll=0.1, yaw=math.pi / 2))
    expected = torch.stack((0 * ONES, -400.0 / 33.0 * ROBOTS.total_mass * 0.1, 0 * ONES), dim=1)
    assert torch.allclose(torque, expected, atol=1e-6)


def test_torque_leads_to_the_commanded_pitch_and_is_capped() -> None:
    state = tilted(pitch=0.1)
    state.command[:, 4] = 0.1
    assert torch.allclose(pull(state)[1], torch.zeros(N, 3, dtype=torch.float64), atol=1e-9)
    state.command[:, 4] = 2.0
    assert torch.allclose(pull(state)[1][:, 1], 120.0 / 33.0 * ROBOTS.total_mass)


def test_support_grows_below_the_commanded_height_up_to_its_cap_and_never_pulls_down() -> None:
    state = quiet_state(ROBOTS)
    state.base_height = ROBOTS.nominal_height - 0.05
    assert torch.allclose(pull(state)[0][:, 2], 0.35 * WEIGHT + 30.0 * 0.05 * ROBOTS.total_mass)
    state.base_height = ROBOTS.nominal_height - 0.5
    assert torch.allclose(pull(state)[0][:, 2], 0.6 * WEIGHT)
    state.command[:, 3] = -0.7
    assert not pull(state)[0].any(), "far above the commanded height"


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_force_and_torque_are_bounded_whatever_the_state(seed: int) -> None:
    force, torque = pull(random_state(seed, ROBOTS))
    assert (force[:, :2].norm(dim=1) <= 0.15 * math.sqrt(2) * WEIGHT + 1e-9).all()
    assert (torque.norm(dim=1) <= 120.0 / 33.0 * math.sqrt(2) * ROBOTS.total_mass + 1e-9).all()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_the_mirrored_robot_gets_the_mirrored_wrench(seed: int) -> None:
    state = random_state(seed, ROBOTS)
    mirrored = harness_wrench(mirror_state(state, ObservationsCfg()), ROBOTS, ONES)
    sign = torch.tensor([1.0, -1, 1, -1, 1, -1], dtype=torch.float64)
    assert torch.allclose(harness_wrench(state, ROBOTS, ONES) * sign, mirrored, atol=1e-9)


def test_damping_grows_with_mass_and_vanishes_with_the_harness() -> None:
    assert torch.allclose(harness_damping(ROBOTS, 0.5 * ONES), 6.0 / 33.0 * ROBOTS.total_mass)
    assert not harness_damping(ROBOTS, 0.0 * ONES).any()
