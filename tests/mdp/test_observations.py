from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from eagle_rl.config.schema import ObservationsCfg
from eagle_rl.errors import ConfigError
from eagle_rl.runners.root import clock_columns
from envs.mdp.layout import EMBODIMENT, ObservationLayout, scan_points
from envs.mdp.observations import (
    History,
    clock_observation,
    command_observation,
    critic_observation,
    delay,
    estimation_target,
    noise_scale,
    proprioception,
)
from envs.mdp.symmetry import mirror_state
from envs.robots.embodiment import Descriptor, embodiment_dim
from envs.state import PooledRobots, PooledState
from tests.states import quaternion, quiet_state, random_robots, random_state

CFG = ObservationsCfg()
FRICTION = (0.5, 1.5)
LAYOUT = ObservationLayout(CFG)
EMBODIMENT_DIM = 30
ROBOTS = random_robots(0)
N = len(ROBOTS.robot_id)


def embodiment(seed: int = 0) -> Tensor:
    return torch.randn(N, EMBODIMENT_DIM, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def critic_of(
    state: PooledState,
    robots: PooledRobots,
    o_ea: Tensor | None,
    cfg: ObservationsCfg = CFG,
    friction_range: tuple[float, float] = FRICTION,
) -> Tensor:
    return critic_observation(proprioception(state, robots, cfg), state, robots, o_ea, cfg, friction_range)


def groups(state: PooledState, robots: PooledRobots, o_ea: Tensor, cfg: ObservationsCfg = CFG) -> dict[str, Tensor]:
    """Every observation group, with K copies of the same frame as history."""
    return {
        "history": proprioception(state, robots, cfg).repeat(1, cfg.history_length),
        "command": command_observation(state, cfg),
        "clock": clock_observation(state, cfg),
        "critic": critic_of(state, robots, o_ea, cfg),
        "estimate": estimation_target(state, o_ea, cfg),
        "actions": state.actions,
    }


def critic_column(state: PooledState, name: str) -> Tensor:
    return critic_of(state, ROBOTS, embodiment())[:, LAYOUT.columns("critic", name)]


def test_layout_has_the_size_of_every_group() -> None:
    made = groups(random_state(0, ROBOTS), ROBOTS, embodiment())
    assert {name: value.shape[1] for name, value in made.items()} == {name: LAYOUT.size(name) for name in made}
    assert LAYOUT.frame_size == 3 + 3 + 32 + 32 + 32
    assert LAYOUT.num_scan_points == len(scan_points(CFG)) == 9 * 7


def test_without_embodiment_and_last_action_the_groups_shrink() -> None:
    cfg = replace(CFG, last_action=False, embodiment_observation=False)
    layout, state = ObservationLayout(cfg), random_state(0, ROBOTS)
    assert proprioception(state, ROBOTS, cfg).shape[1] == layout.frame_size == 70
    assert noise_scale(cfg, ROBOTS).shape[1] == 70
    assert estimation_target(state, None, cfg).shape[1] == layout.size("estimate") == 3
    critic = critic_of(state, ROBOTS, None, cfg)
    assert critic.shape[1] == layout.size("critic") == LAYOUT.size("critic") - 32 - EMBODIMENT_DIM


@pytest.mark.parametrize("embodied", [True, False])
def test_harmonics_of_the_clock_come_last_so_that_networks_without_them_grow_at_their_end(embodied: bool) -> None:
    more = replace(CFG, clock_harmonics=3, embodiment_observation=embodied)
    fewer = replace(more, clock_harmonics=0)
    state, o_ea = random_state(0, ROBOTS), embodiment() if embodied else None
    seen, before = clock_observation(state, more), clock_observation(state, fewer)
    assert seen.shape[1] == ObservationLayout(more).size("clock") == clock_columns(more) == 12
    assert before.shape[1] == ObservationLayout(fewer).size("clock") == clock_columns(fewer) == 2
    critic, critic_before = critic_of(state, ROBOTS, o_ea, more), critic_of(state, ROBOTS, o_ea, fewer)
    assert critic.shape[1] == ObservationLayout(more).size("critic")
    assert torch.equal(seen[:, :2], before)
    assert torch.equal(critic, torch.cat((critic_before, seen[:, 2:]), dim=1))


CRITIC_SOURCES = {
    "base_ang_vel": "base_ang_vel_b",
    "projected_gravity": "projected_gravity_b",
    "joint_pos_rel": "joint_pos",
    "joint_vel": "joint_vel",
    "last_action": "actions",
    "clock": "foot_phase",
    "base_lin_vel": "base_lin_vel_b",
    "foot_clearance": "foot_height",
    "foot_force": "foot_force_w",
    "friction": "friction",
    "height_scan": "height_scan",
}
"""Quantity behind each term of the critic's table that depends on one quantity alone."""


@pytest.mark.parametrize(("term", "source"), CRITIC_SOURCES.items())
def test_each_quantity_moves_its_own_columns_by_its_scale(term: str, source: str) -> None:
    state = quiet_state(ROBOTS)
    state.foot_phase = torch.zeros_like(state.foot_phase)
    moved = replace(state, **{source: getattr(state, source) + 1e-3})
    difference = critic_of(moved, ROBOTS, embodiment()) - critic_of(state, ROBOTS, embodiment())
    columns = LAYOUT.columns("critic", term)
    touched = torch.zeros_like(difference, dtype=torch.bool)
    touched[:, columns] = True
    assert not difference[~touched].any(), f"{source} leaks outside {term}"
    gain = {"height_scan": -1.0, "clock": 2 * math.pi, "friction": 2.0}.get(term, 1.0)
    expected = torch.tensor(LAYOUT.scale("critic")[columns], dtype=torch.float64) * gain * 1e-3
    expected = expected.expand(N, -1)
    if term == "foot_force":
        expected = expected * (33.0 / ROBOTS.total_mass).unsqueeze(1)
    if term == "joint_pos_rel":
        expected = expected * ROBOTS.slot_mask
    assert torch.allclose(difference[:, columns], expected, rtol=1e-4, atol=1e-9)


def test_frame_is_scaled_and_relative_to_the_default_pose() -> None:
    state = random_state(1, ROBOTS)
    frame = proprioception(state, ROBOTS, CFG)
    parts = torch.split(frame, [3, 3, 32, 32, 32], dim=1)
    expected = (
        0.5 * state.base_ang_vel_b,
        3.0 * state.projected_gravity_b,
        2.0 * (state.joint_pos - ROBOTS.default_joint_pos),
        0.1 * state.joint_vel,
        0.5 * state.actions,
    )
    for part, value in zip(parts, expected, strict=True):
        assert torch.allclose(part, value)


def test_observations_are_bounded() -> None:
    state = random_state(1, ROBOTS)
    state.joint_vel = state.joint_vel * 1e6
    state.foot_force_w = state.foot_force_w * 1e9
    for name, value in groups(state, ROBOTS, embodiment() * 1e6).items():
        if name != "actions":
            assert value.abs().max().item() <= CFG.clip, name


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 3))
def test_mirroring_the_robot_mirrors_every_observation(seed: int, clock_harmonics: int) -> None:
    cfg = replace(CFG, clock_harmonics=clock_harmonics)
    robots = random_robots(seed, symmetric=True)
    state, o_ea = random_state(seed, robots), embodiment(seed)
    mirror = ObservationLayout(cfg).mirror()
    perm, sign = mirror["estimate"]
    o_ea_mirrored = (torch.cat((state.base_lin_vel_b, o_ea), dim=1)[:, perm] * sign)[:, 3:]
    seen = groups(state, robots, o_ea, cfg)
    reflected = groups(mirror_state(state, cfg), robots, o_ea_mirrored, cfg)
    for name, value in seen.items():
        perm, sign = mirror[name]
        assert torch.allclose(value[:, perm] * sign, reflected[name], rtol=0, atol=1e-9), name


def test_every_mirror_undoes_itself() -> None:
    for name, (perm, sign) in LAYOUT.mirror().items():
        x = torch.randn(4, LAYOUT.size(name))
        assert torch.equal((x[:, perm] * sign)[:, perm] * sign, x), name


def test_embodiment_mirror_swaps_feet_and_flips_what_is_odd_in_y() -> None:
    perm, sign = LAYOUT.mirror()["estimate"]
    torso = torch.arange(10.0) + 1.0
    x = torch.cat((torch.zeros(3), torso, torso + 100, torso + 200)).unsqueeze(0)
    odd = torch.tensor([1.0, 1, -1, 1, 1, 1, 1, -1, 1, -1])  # mass, com xyz, inertia xx yy zz xy xz yz
    expected = torch.cat((torch.zeros(3), torso * odd, (torso + 200) * odd, (torso + 100) * odd))
    assert torch.equal((x[:, perm] * sign)[0], expected)


def test_scan_points_run_over_x_outside_and_y_inside_and_mirror_in_y() -> None:
    points = scan_points(CFG)
    assert points[0].tolist() == pytest.approx([-0.42, -0.42])
    assert points[6].tolist() == pytest.approx([-0.42, 0.42])
    assert points[-1].tolist() == pytest.approx([0.70, 0.42])
    columns = LAYOUT.columns("critic", "height_scan")
    perm = LAYOUT.mirror()["critic"][0][columns] - columns.start
    assert torch.allclose(points[perm], points * torch.tensor([1.0, -1.0], dtype=torch.float64))


def test_a_lopsided_scan_is_refused() -> None:
    with pytest.raises(ConfigError, match="scan_y"):
        ObservationLayout(replace(CFG, scan_y=(-0.42, 0.35, 12)))


@pytest.mark.parametrize("descriptor", ["paper", "extended"])
def test_layout_has_the_size_and_mirror_of_either_descriptor(descriptor: Descriptor) -> None:
    layout = ObservationLayout(replace(CFG, descriptor=descriptor))
    assert layout.size("estimate") == 3 + embodiment_dim(descriptor)
    perm = torch.tensor(EMBODIMENT[descriptor].perm)
    assert torch.equal(perm[perm], torch.arange(embodiment_dim(descriptor)))


def test_height_error_is_measured_against_the_command_and_clipped() -> None:
    state = quiet_state(ROBOTS)
    state.base_height = ROBOTS.nominal_height - 0.05
    state.command[:, 3] = -0.2
    assert critic_column(state, "height_error").flatten().tolist() == pytest.approx([0.15 * 5.0] * N)
    state.base_height = ROBOTS.nominal_height + 9.0
    assert critic_column(state, "height_error").flatten().tolist() == pytest.approx([0.5 * 5.0] * N)


def test_foot_forces_are_seen_in_the_yaw_frame_whatever_the_lean() -> None:
    state = quiet_state(ROBOTS)
    state.root_quat_w = quaternion(pitch=0.4, yaw=math.pi / 2).expand(N, 4)
    state.foot_force_w = torch.tensor([[0.0, 20.0, 300.0], [-10.0, 0.0, 0.0]], dtype=torch.float64).expand(N, 2, 3)
    yaw_frame = torch.tensor([20.0, 0.0, 300.0, 0.0, 10.0, 0.0], dtype=torch.float64)
    expected = yaw_frame * 0.005 * (33.0 / ROBOTS.total_mass).unsqueeze(1)
    assert torch.allclose(critic_column(state, "foot_force"), expected, atol=1e-9)


def test_link_collisions_are_forces_above_two_newtons() -> None:
    state = quiet_state(ROBOTS)
    state.link_force_w[:, 2] = torch.tensor([1.5, 0.0, 1.5], dtype=torch.float64)
    state.link_force_w[:, 3] = torch.tensor([0.0, 1.9, 0.0], dtype=torch.float64)
    assert critic_column(state, "link_collision")[0].tolist() == [0, 0, 1, 0, 0, 0, 0]


@pytest.mark.parametrize(("friction", "expected"), [(0.5, -0.5), (1.0, 0.0), (1.5, 0.5)])
def test_friction_maps_its_range_to_one_half(friction: float, expected: float) -> None:
    state = quiet_state(ROBOTS)
    state.friction = torch.full_like(state.friction, friction)
    assert critic_column(state, "friction").flatten().tolist() == pytest.approx([expected] * N)


def test_friction_is_zero_where_it_is_not_randomized() -> None:
    critic = critic_of(random_state(0, ROBOTS), ROBOTS, embodiment(), friction_range=(1.0, 1.0))
    assert not critic[:, LAYOUT.columns("critic", "friction")].any()


def test_height_scan_reads_the_height_of_the_base_above_each_point() -> None:
    state = quiet_state(ROBOTS)
    state.base_height = ROBOTS.nominal_height - 0.1
    state.height_scan[:, 4] = 0.03
    scan = critic_column(state, "height_scan")
    assert scan[:, 4].tolist() == pytest.approx([-0.13 * 5.0] * N)
    assert scan[:, 5].tolist() == pytest.approx([-0.10 * 5.0] * N)


def test_estimation_target_is_base_velocity_then_embodiment() -> None:
    state = random_state(0, ROBOTS)
    target = estimation_target(state, embodiment(), CFG)
    assert torch.allclose(target[:, :3], 2.0 * state.base_lin_vel_b)
    assert torch.equal(target[:, 3:], embodiment())


def test_noise_touches_sensors_of_present_joints_alone() -> None:
    scale = noise_scale(CFG, ROBOTS)
    base, gravity, pos, vel, action = torch.split(scale, [3, 3, 32, 32, 32], dim=1)
    assert torch.allclose(base, torch.full_like(base, 0.2 * 0.5))
    assert torch.allclose(gravity, torch.full_like(gravity, 0.05 * 3.0))
    assert torch.allclose(pos, 0.01 * 2.0 * ROBOTS.slot_mask)
    assert torch.allclose(vel, 1.5 * 0.1 * ROBOTS.slot_mask)
    assert not action.any()
    assert not noise_scale(replace(CFG, enable_corruption=False), ROBOTS).any()


def test_absent_slots_of_a_frame_are_zero() -> None:
    frame = proprioception(random_state(5, ROBOTS), ROBOTS, CFG)
    for block in torch.split(frame, [3, 3, 32, 32, 32], dim=1)[2:]:
        assert not block[ROBOTS.slot_mask == 0].any()


def test_latency_blends_sensors_and_spares_the_last_action() -> None:
    current, previous = torch.ones(3, 102), torch.zeros(3, 102)
    seen = delay(current, previous, torch.tensor([[0.0], [0.25], [1.0]]))
    assert torch.equal(seen, torch.tensor([[1.0], [0.75], [0.0]]).expand(3, 70)), "the last 32 columns are the action"


def test_history_is_newest_first_and_starts_full() -> None:
    history = History(2, 3, torch.zeros(2, 4))
    history.reset(torch.arange(2), torch.full((2, 4), 1.0))
    first = history.flat
    history.push(torch.full((2, 4), 2.0))
    history.push(torch.full((2, 4), 3.0))
    assert history.flat[0].tolist() == [3.0] * 4 + [2.0] * 4 + [1.0] * 4
    history.reset(torch.tensor([1]), torch.full((1, 4), 9.0))
    assert history.flat[1].tolist() == [9.0] * 12
    assert history.flat[0].tolist() == [3.0] * 4 + [2.0] * 4 + [1.0] * 4, "reset must touch its own rows alone"
    assert first.tolist() == [[1.0] * 12] * 2, "an observation handed out must not change"
