from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from eagle_rl.config.schema import GaitCfg, ObservationsCfg, RewardsCfg, RewardWeightsCfg
from envs.mdp.rewards import REWARD_TERMS, RewardContext, compute_rewards, reward_factors, success_scores
from envs.mdp.symmetry import mirror_state
from envs.robots.slots import SLOT_INDEX
from envs.state import PooledRobots, PooledState
from tests.states import quiet_state, random_robots, random_state

DT = 0.02
ROBOTS = random_robots(0)
ROBOTS.slot_mask = torch.ones_like(ROBOTS.slot_mask)
N = len(ROBOTS.robot_id)

PRINTED_TABLE = {
    "lin_vel_tracking": 2,
    "ang_vel_tracking": 2.5,
    "base_height": -60,
    "body_pitch": -1,
    "foot_swing": -30,
    "contact_vel": -1,
    "contact_force": -1,
    "roll_pitch_rate": -0.1,
    "vertical_speed": -2,
    "foot_slip": -0.1,
    "action_rate": -2e-3,
    "action_smoothness": -2e-3,
    "joint_torque": -1e-5,
    "joint_acceleration": -5e-8,
    "upper_deviation": -5,
    "hip_deviation": -0.4,
    "base_orientation": -5,
}
"""Coefficients of the paper's table "Training reward terms", top to bottom."""
INHERITED = {"termination": -200, "alive": 0.2, "joint_limits": -10}
"""Terms the paper keeps from HugWBC without printing them."""
OURS = {"landing": 0}
PENALTY_CURRICULUM = {
    "base_height",
    "body_pitch",
    "base_orientation",
    "roll_pitch_rate",
    "vertical_speed",
    "action_rate",
    "action_smoothness",
    "joint_torque",
    "joint_acceleration",
}


def context(shaping: float = 0.0, terminated: bool = False, **cfg: Any) -> RewardContext:
    return RewardContext(
        cfg=RewardsCfg(**cfg),
        gait=GaitCfg(),
        gait_shaping=torch.full((N,), shaping, dtype=torch.float64),
        terminated=torch.full((N,), terminated),
    )


def weighted(
    state: PooledState, robots: PooledRobots, ctx: RewardContext, k: float
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    return compute_rewards(state, robots, ctx, reward_factors(ctx.cfg.weights, k, DT, state.joint_pos))


def state_with(**rows: Any) -> PooledState:
    """Standing still, but for the given quantities, the same in every environment."""
    state = quiet_state(ROBOTS)
    for name, value in rows.items():
        old = getattr(state, name)
        setattr(state, name, torch.as_tensor(value).to(old.dtype).expand_as(old).clone())
    return state


def value(name: str, state: PooledState, ctx: RewardContext | None = None) -> float:
    result = REWARD_TERMS[name].function(state, ROBOTS, ctx or context())
    assert result.shape == (N,)
    assert torch.allclose(result, result[0].expand(N)), f"{name} differs between equal environments"
    return result[0].item()


def slot_values(**angles: float) -> torch.Tensor:
    row = torch.zeros(32, dtype=torch.float64)
    for name, angle in angles.items():
        row[SLOT_INDEX[name]] = angle
    return row


def test_paper_mode_has_the_printed_coefficients() -> None:
    weights = {f.name: getattr(RewardWeightsCfg(), f.name) for f in fields(RewardWeightsCfg)}
    assert weights == PRINTED_TABLE | INHERITED | OURS


def test_paper_mode_has_the_printed_kernels() -> None:
    cfg = RewardsCfg(orientation="upright")
    kappas = (cfg.tracking_kappa, cfg.contact_vel_kappa, cfg.contact_force_kappa, cfg.foot_slip_kappa)
    assert kappas == (0.25, 5, 50, 1)
    assert cfg.standing_kappa == cfg.walking_kappa == cfg.tracking_kappa


def test_terms_and_weights_have_the_same_names() -> None:
    assert list(REWARD_TERMS) == [f.name for f in fields(RewardWeightsCfg)]


def test_penalty_curriculum_covers_the_marked_rows() -> None:
    assert {name for name, term in REWARD_TERMS.items() if term.curriculum} == PENALTY_CURRICULUM


def test_standing_still_costs_nothing() -> None:
    terms = {name: value(name, state_with()) for name in REWARD_TERMS}
    rewards = {name: terms.pop(name) for name in ("lin_vel_tracking", "ang_vel_tracking", "alive")}
    assert rewards == dict.fromkeys(rewards, 1.0)
    assert terms == {name: pytest.approx(0.0, abs=1e-9) for name in terms}


def test_lin_vel_tracking() -> None:
    state = state_with(command=[0.5, 0.1, 0, 0, 0], base_lin_vel_b=[0.2, -0.3, 9.0])
    assert value("lin_vel_tracking", state) == pytest.approx(math.exp(-(0.3**2 + 0.4**2) / 0.25))


def test_a_narrower_kernel_is_half_of_the_tracking_rewards_while_standing() -> None:
    still = state_with(standing=True, base_lin_vel_b=[0.1, 0, 0], base_ang_vel_b=[0, 0, 0.3])
    ctx = context(standing_kappa=0.02)
    for term, squared in (("lin_vel_tracking", 0.01), ("ang_vel_tracking", 0.09)):
        expected = 0.5 * (math.exp(-squared / 0.25) + math.exp(-squared / 0.02))
        assert value(term, still, ctx) == pytest.approx(expected), term
    walking = state_with(standing=False, command=[0, 0.2, 0, 0, 0], base_lin_vel_b=[0.1, 0.2, 0])
    assert value("lin_vel_tracking", walking, context(standing_kappa=0.02)) == pytest.approx(math.exp(-0.01 / 0.25))


def test_walking_has_a_narrower_kernel_of_its_own() -> None:
    walking = state_with(
        standing=False, command=[0.5, 0, 0.4, 0, 0], base_lin_vel_b=[0.3, 0, 0], base_ang_vel_b=[0, 0, 0.1]
    )
    ctx = context(walking_kappa=0.05, standing_kappa=0.02)
    for term, squared in (("lin_vel_tracking", 0.04), ("ang_vel_tracking", 0.09)):
        expected = 0.5 * (math.exp(-squared / 0.25) + math.exp(-squared / 0.05))
        assert value(term, walking, ctx) == pytest.approx(expected), term


def test_success_is_judged_by_the_table_s_kernel_alone() -> None:
    state = state_with(
        standing=False, command=[0.5, 0, 0.4, 0, 0], base_lin_vel_b=[0.3, 0, 0], base_ang_vel_b=[0, 0, 0.1]
    )
    lin, ang, *_ = success_scores(state, ROBOTS, context(walking_kappa=0.01, standing_kappa=0.01))
    assert lin[0].item() == pytest.approx(math.exp(-0.04 / 0.25))
    assert ang[0].item() == pytest.approx(math.exp(-0.09 / 0.25))


def test_ang_vel_tracking() -> None:
    state = state_with(command=[0, 0, 0.8, 0, 0], base_ang_vel_b=[9.0, 9.0, 0.3])
    assert value("ang_vel_tracking", state) == pytest.approx(math.exp(-(0.5**2) / 0.25))


def test_base_height_is_relative_to_each_robots_nominal_height() -> None:
    state = state_with(command=[0, 0, 0, -0.2, 0])
    state.base_height = ROBOTS.nominal_height - 0.05
    assert value("base_height", state) == pytest.approx(0.15**2)


def leaning(pitch: float, command: float = 0.0) -> PooledState:
    return state_with(projected_gravity_b=[math.sin(pitch), 0, -math.cos(pitch)], command=[0, 0, 0, 0, command])


def test_body_pitch_is_positive_leaning_forward() -> None:
    assert value("body_pitch", leaning(0.3, command=0.5)) == pytest.approx(0.2**2)


def test_base_orientation_upright_fights_the_pitch_command() -> None:
    ctx = context(orientation="upright")
    assert value("base_orientation", leaning(0.3, command=0.3), ctx) == pytest.approx(math.sin(0.3) ** 2)


def test_base_orientation_commanded_is_zero_where_the_robot_leans_as_told() -> None:
    ctx = context(orientation="commanded")
    assert value("base_orientation", leaning(0.3, command=0.3), ctx) == pytest.approx(0.0)
    rolled = state_with(projected_gravity_b=[0.0, 0.6, -0.8])
    assert value("base_orientation", rolled, ctx) == pytest.approx(0.36), "roll still counts"


def test_foot_swing_asks_the_swing_foot_for_its_height() -> None:
    state = state_with(foot_phase=[0.75, 0.25])
    state.foot_height[:, 0] = ROBOTS.swing_height - 0.04
    state.foot_height[:, 1] = 0.2  # in stance: any height is free
    assert value("foot_swing", state) == pytest.approx(0.04**2, rel=1e-4)


def test_foot_swing_is_clipped() -> None:
    assert value("foot_swing", state_with(foot_phase=[0.75, 0.75], foot_height=[1.0, 1.0])) == 0.1


def test_contact_vel_counts_horizontal_speed_in_stance() -> None:
    feet = torch.tensor([[0.3, 0.4, 5.0], [3.0, 4.0, 0.0]])
    state = state_with(foot_phase=[0.25, 0.75], foot_vel_w=feet)
    assert value("contact_vel", state) == pytest.approx(1 - math.exp(-0.25 / 5), rel=1e-4)


def test_contact_force_counts_vertical_load_in_swing() -> None:
    forces = torch.tensor([[0.0, 0.0, 200.0], [2.0, 3.0, 6.0]])
    state = state_with(foot_phase=[0.25, 0.75], foot_force_w=forces)
    assert value("contact_force", state) == pytest.approx(1 - math.exp(-49 / 50), rel=1e-4)


def test_gait_shaping_widens_the_force_kernel() -> None:
    state = state_with(foot_phase=[0.25, 0.75], foot_force_w=torch.tensor([[0.0, 0, 200], [0.0, 0, 80]]))
    loaded = REWARD_TERMS["contact_force"].function(state, ROBOTS, context(shaping=0.5))
    for mass, error in zip(ROBOTS.total_mass.tolist(), loaded.tolist(), strict=True):
        kappa = 50 + 5000 * (mass / 33.0) ** 2
        assert error == pytest.approx(1 - math.exp(-6400 / kappa), rel=1e-4), f"robot of {mass} kg"


def test_roll_pitch_rate() -> None:
    assert value("roll_pitch_rate", state_with(base_ang_vel_b=[0.3, 0.4, 7.0])) == pytest.approx(0.25)


def test_vertical_speed() -> None:
    assert value("vertical_speed", state_with(base_lin_vel_b=[7.0, 7.0, -0.3])) == pytest.approx(0.09)


@pytest.mark.parametrize(
    ("force", "last_contact", "expected"),
    [(0.0, False, 0.0), (2.0, False, 1 - math.exp(-0.25)), (0.0, True, 1 - math.exp(-0.25))],
)
def test_foot_slip_counts_feet_in_contact_now_or_one_step_ago(
    force: float, last_contact: bool, expected: float
) -> None:
    feet = torch.tensor([[0.3, 0.4, 3.0], [0.0, 0.0, 0.0]])
    state = state_with(foot_vel_w=feet, foot_force_w=[0.0, 0.0, force], last_foot_contact=last_contact)
    assert value("foot_slip", state) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("vertical", "height", "force", "expected"),
    [
        (-1.2, 0.0, 0.0, 1.69),  # 0.3^2 + 0.4^2 + 1.2^2
        (-1.2, 0.05, 0.0, 1.69 / math.e),
        (-1.2, -0.01, 0.0, 1.69),
        (1.2, 0.0, 0.0, 0.0),
        (-1.2, 0.0, 2.0, 0.0),
    ],
    ids=["down on the ground", "down at the height", "into the ground", "up", "has landed"],
)
def test_landing_counts_the_speed_of_feet_that_come_down(
    vertical: float, height: float, force: float, expected: float
) -> None:
    feet = torch.tensor([[0.3, 0.4, vertical], [0.0, 0.0, 0.0]])
    state = state_with(foot_vel_w=feet, foot_height=[height, 0.2], foot_force_w=[0.0, 0.0, force])
    assert value("landing", state) == pytest.approx(expected)


def test_action_rate_and_smoothness() -> None:
    state = state_with(
        actions=slot_values(left_hip_roll=1.0, waist_yaw=0.5),
        last_actions=slot_values(left_hip_roll=0.4),
        last_last_actions=slot_values(waist_yaw=-0.3),
    )
    assert value("action_rate", state) == pytest.approx(0.6**2 + 0.5**2)
    assert value("action_smoothness", state) == pytest.approx((1.0 - 0.8) ** 2 + (0.5 - 0.3) ** 2)


def test_joint_torque_and_acceleration() -> None:
    row = slot_values(left_knee_pitch=3.0, head_yaw=4.0)
    assert value("joint_torque", state_with(joint_torque=row)) == pytest.approx(25.0)
    assert value("joint_acceleration", state_with(joint_acc=row)) == pytest.approx(25.0)


def test_deviations_cover_their_joints_and_no_others() -> None:
    state = state_with()
    state.joint_pos = state.joint_pos + slot_values(
        left_hip_pitch=9.0,
        right_knee_pitch=9.0,
        left_ankle_roll=9.0,
        left_hip_roll=0.3,
        right_hip_yaw=0.4,
        waist_pitch=0.1,
        head_yaw=0.2,
        left_wrist_yaw=0.2,
    )
    assert value("hip_deviation", state) == pytest.approx(0.3**2 + 0.4**2)
    assert value("upper_deviation", state) == pytest.approx(0.1**2 + 0.2**2 + 0.2**2)


def test_joint_limits_measure_radians_beyond_the_soft_limits() -> None:
    state = state_with()
    left, right = SLOT_INDEX["left_knee_pitch"], SLOT_INDEX["right_knee_pitch"]
    state.joint_pos[:, left] = ROBOTS.joint_soft_upper[:, left] + 0.2
    state.joint_pos[:, right] = ROBOTS.joint_soft_lower[:, right] - 0.1
    assert value("joint_limits", state) == pytest.approx(0.3)


def test_a_fall_costs_four_once() -> None:
    _, terms = weighted(state_with(), ROBOTS, context(terminated=True), 1.0)
    assert terms["termination"].tolist() == pytest.approx([-4.0] * N)
    assert terms["alive"].tolist() == pytest.approx([0.004] * N)


def test_total_is_the_weighted_sum_over_the_control_step() -> None:
    state, k, ctx = random_state(1, ROBOTS), 0.2, context()
    total, terms = weighted(state, ROBOTS, context(), k)
    expected = {
        name: weight * DT * (k if name in PENALTY_CURRICULUM else 1) * REWARD_TERMS[name].function(state, ROBOTS, ctx)
        for name, weight in (PRINTED_TABLE | INHERITED).items()
    }
    assert terms.keys() == expected.keys()
    for name, value_ in expected.items():
        assert torch.allclose(terms[name], value_), name
    assert torch.allclose(total, torch.stack(list(expected.values())).sum(0))


def test_terms_of_zero_weight_are_left_out() -> None:
    weights = RewardWeightsCfg(**{f.name: 0.0 for f in fields(RewardWeightsCfg) if f.name != "alive"})
    total, terms = weighted(state_with(), ROBOTS, context(weights=weights), 1.0)
    assert list(terms) == ["alive"]
    assert total.tolist() == pytest.approx([0.004] * N)
    nothing, _ = weighted(state_with(), ROBOTS, context(weights=replace(weights, alive=0.0)), 1.0)
    assert nothing.tolist() == [0.0] * N


def test_gait_shaping_scales_the_gait_terms_alone() -> None:
    state = random_state(2, ROBOTS)
    _, plain = weighted(state, ROBOTS, context(), 1.0)
    _, shaped = weighted(state, ROBOTS, context(shaping=0.5), 1.0)
    changed = {name for name in plain if not torch.equal(plain[name], shaped[name])}
    assert changed == {"foot_swing", "contact_vel", "contact_force"}
    assert torch.allclose(shaped["contact_vel"], 2.0 * plain["contact_vel"])


def test_success_scores_ignore_gait_shaping_and_lie_in_the_unit_interval() -> None:
    state = random_state(3, ROBOTS)
    scores = torch.stack(success_scores(state, ROBOTS, context(shaping=1.0)))
    assert torch.equal(scores, torch.stack(success_scores(state, ROBOTS, context())))
    assert scores.min() >= 0.0
    assert scores.max() <= 1.0
    at_best = torch.stack(success_scores(state_with(), ROBOTS, context()))
    assert torch.allclose(at_best, torch.ones_like(at_best))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["upright", "commanded"]))
def test_every_term_is_the_same_in_the_mirror(seed: int, orientation: str) -> None:
    robots = random_robots(seed, symmetric=True)
    state = random_state(seed, robots)
    mirrored = mirror_state(state, ObservationsCfg())
    for name, term in REWARD_TERMS.items():
        seen, reflected = (term.function(s, robots, context(orientation=orientation)) for s in (state, mirrored))
        assert torch.allclose(seen, reflected, rtol=0, atol=1e-9), f"{name} differs in the mirror"


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 10_000))
def test_absent_slots_change_nothing(seed: int) -> None:
    robots = random_robots(seed)
    state = random_state(seed, robots)
    before, _ = weighted(state, robots, context(), 1.0)
    absent = 1.0 - robots.slot_mask
    for name in ("joint_pos", "joint_vel", "joint_acc", "joint_torque", "actions", "last_actions", "last_last_actions"):
        setattr(state, name, getattr(state, name) + 7.0 * absent)
    after, _ = weighted(state, robots, context(), 1.0)
    assert torch.equal(before, after)
