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


def test_aids_decay_only_while_their_own_condition_holds() -> None:
    aids = LearningAids(AidsCfg(), 2)
    for _ in range(100):  # longer than the running means remember
        aids.update(torch.tensor([0.9, 0.3]), torch.tensor([0.5, 0.9]))
    before = aids.harness.clone(), aids.gait_shaping.clone()
    aids.update(torch.tensor([0.9, 0.3]), torch.tensor([0.5, 0.9]))
    assert (aids.harness / before[0]).tolist() == pytest.approx([0.98, 1.0])
    assert (aids.gait_shaping / before[1]).tolist() == pytest.approx([1.0, 0.98])
    assert aids.harness[1] == aids.gait_shaping[0] == 1.0, "never fulfilled"
    assert aids.log(["a", "b"])["Curriculum/harness/a"] == aids.harness[0].item()


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
    first, second = LearningAids(AidsCfg(), 2), LearningAids(AidsCfg(harness=0.0), 2)
    for _ in range(50):
        first.update(torch.tensor([1.0, 0.0]), GOOD)
    second.load_state_dict(first.state_dict())
    first.update(GOOD, BAD)
    second.update(GOOD, BAD)
    assert torch.equal(first.harness, second.harness)
    assert torch.equal(first.gait_shaping, second.gait_shaping)


def test_a_robot_that_does_as_told_feels_nothing() -> None:
    assert not harness_wrench(quiet_state(ROBOTS), ROBOTS, ONES).any()


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


def test_support_lifts_by_at_most_half_the_weight_and_never_pulls_down() -> None:
    state = quiet_state(ROBOTS)
    state.base_height = ROBOTS.nominal_height - 0.05
    assert torch.allclose(pull(state)[0][:, 2], 50.0 * 0.05 * ROBOTS.total_mass)
    state.base_height = ROBOTS.nominal_height - 0.5
    assert torch.allclose(pull(state)[0][:, 2], 0.5 * WEIGHT)
    state.command[:, 3] = -0.6
    assert not pull(state)[0].any(), "already above the commanded height"


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
