from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from eagle_rl.config.schema import CommandCurriculumCfg, CommandRangeCfg, CommandsCfg
from eagle_rl.errors import ConfigError
from envs.mdp.commands import CommandSampler
from envs.rng import CounterRng
from tests.states import random_robots

CFG = CommandsCfg()
NUM_ROBOTS = 2
WINDOW = 500


def sampler(cfg: CommandsCfg = CFG, seed: int = 0, num_envs: int = 200, num_robots: int = NUM_ROBOTS) -> CommandSampler:
    robots = random_robots(0, num_envs, num_robots)
    names = [f"robot{i}" for i in robots.robot_id.tolist()]
    return CommandSampler(cfg, robots, num_robots, CounterRng(seed, names, torch.arange(num_envs)))


def sample(s: CommandSampler, ids: torch.Tensor, count: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Close some environments' windows and open the next; their commands, and whether all velocities are zero."""
    s.close(ids)
    drawn = s.draw(ids, count)
    s.open(ids, drawn)
    return drawn.command, (drawn.command[:, :3] == 0.0).all(dim=1)


def draw(s: CommandSampler, count: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    ids = torch.arange(len(s.robot_id))
    return sample(s, ids, torch.full_like(ids, count))


def track(s: CommandSampler, steps: int = WINDOW, **scores: float) -> None:
    """Accumulate a window; by default every score is just above its threshold."""
    values = {"lin_vel": 0.81, "ang_vel": 0.41, "force": 0.81, "vel": 0.81} | scores
    for _ in range(steps):
        s.accumulate(torch.tensor(list(values.values())).expand(len(s.robot_id), -1))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31), st.integers(0, 1000), st.booleans())
def test_commands_stay_in_their_ranges(seed: int, count: int, complete: bool) -> None:
    s = sampler(replace(CFG, curriculum=CommandCurriculumCfg(enabled=not complete)), seed)
    command, _ = draw(s, count)
    for column, ranges in enumerate((CFG.lin_vel_x, CFG.lin_vel_y, CFG.ang_vel_z, CFG.base_height, CFG.body_pitch)):
        low, high = ranges.finishing if complete else ranges.initial
        assert low - 1e-6 <= command[:, column].min().item(), f"command {column}"
        assert command[:, column].max().item() <= high + 1e-6, f"command {column}"


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31))
def test_small_velocities_are_zero_and_standing_means_all_three_are(seed: int) -> None:
    command, standing = draw(sampler(seed=seed))
    speed = torch.linalg.vector_norm(command[:, :2], dim=1)
    assert not ((speed > 0) & (speed <= CFG.lin_vel_dead_zone)).any()
    assert not ((command[:, 2] != 0) & (command[:, 2].abs() <= CFG.ang_vel_dead_zone)).any()
    assert torch.equal(standing, (command[:, :3] == 0).all(dim=1))
    assert (command[:, 3] < 0).all(), "posture is commanded to standing robots too"


def test_a_tenth_of_the_draws_stand() -> None:
    cfg = replace(CFG, lin_vel_dead_zone=0.0, ang_vel_dead_zone=0.0)
    share = torch.cat([draw(sampler(cfg), count)[1] for count in range(20)]).double().mean().item()
    assert share == pytest.approx(CFG.standing_probability, abs=0.02)


def test_a_share_of_the_draws_is_upright_and_moves_nothing_else() -> None:
    cfg = replace(CFG, upright_probability=0.3)
    commands, others = (torch.cat([draw(sampler(c), count)[0] for count in range(20)]) for c in (cfg, CFG))
    upright = (commands[:, 3:] == 0).all(dim=1)
    assert upright.double().mean().item() == pytest.approx(0.3, abs=0.02)
    assert torch.equal(commands[:, :3], others[:, :3]), "velocities are drawn as without"
    assert torch.equal(commands[~upright], others[~upright])
    assert not (others[:, 3:] == 0).any()


def test_draws_fill_the_range_evenly_once_the_curriculum_is_done() -> None:
    cfg = replace(CFG, curriculum=CommandCurriculumCfg(enabled=False), standing_probability=0.0)
    command = torch.cat([draw(sampler(cfg), count)[0] for count in range(50)])
    moving = command[command[:, :2].norm(dim=1) > 0]
    assert moving[:, 0].mean().item() == pytest.approx(0.3, abs=0.04)
    counts = torch.histc(command[:, 4], bins=8, min=-0.3, max=0.5)
    assert (counts / len(command)).tolist() == pytest.approx([1 / 8] * 8, abs=0.015)


def test_the_grid_starts_as_the_initial_box() -> None:
    """12 x 8 bins of 0.15 m/s and 0.25 rad/s; [-0.3, 0.6] x [-0.5, 0.5] holds 6 x 4 of them."""
    weights = sampler().weights.view(NUM_ROBOTS, 12, 8)
    expected = torch.zeros(12, 8, dtype=torch.float64)
    expected[2:8, 2:6] = 1.0
    assert torch.equal(weights, expected.expand_as(weights))


def winner(s: CommandSampler, creditable: bool = True) -> int:
    """An environment whose window counts (or does not)."""
    return int((s.state_dict()["creditable"] == creditable).nonzero()[0, 0])


def test_success_raises_the_bin_and_its_neighbours_of_that_robot_alone() -> None:
    s = sampler()
    draw(s)
    state = s.state_dict()
    env = int((state["creditable"] & (state["bin"] == 7 * 8 + 5)).nonzero()[0, 0])  # the upper corner of the box
    track(s)
    before = s.weights.clone()
    sample(s, torch.tensor([env]), torch.tensor([1]))
    gain = (s.weights - before).view(NUM_ROBOTS, 12, 8)
    robot = int(s.robot_id[env])
    expected = torch.zeros(12, 8, dtype=torch.float64)
    expected[6:9, 4:7] = 0.2  # 3 x 3 bins within 0.25
    expected[6:8, 4:6] = 0.0  # already at 1
    assert torch.allclose(gain[robot], expected)
    assert not gain[1 - robot].any()


@pytest.mark.parametrize("score", ["lin_vel", "ang_vel", "force", "vel"])
def test_one_failed_score_fails_the_window(score: str) -> None:
    s = sampler()
    draw(s)
    before = s.weights.clone()
    track(s, **{score: 0.39})
    draw(s, 1)
    assert torch.equal(s.weights, before)


def test_a_window_cut_short_by_a_fall_fails() -> None:
    s = sampler()
    draw(s)
    before = s.weights.clone()
    track(s, steps=WINDOW // 10, lin_vel=1.0, ang_vel=1.0, force=1.0, vel=1.0)
    draw(s, 1)
    assert torch.equal(s.weights, before)


def test_a_window_with_a_fall_in_it_fails() -> None:
    s = sampler()
    draw(s)
    before = s.weights.clone()
    s.spoil(torch.arange(len(s.robot_id)))
    track(s, lin_vel=1.0, ang_vel=1.0, force=1.0, vel=1.0)
    draw(s, 1)
    assert torch.equal(s.weights, before)


def test_windows_with_a_zeroed_velocity_do_not_count() -> None:
    s = sampler()
    draw(s)
    env = winner(s, creditable=False)
    before = s.weights.clone()
    track(s)
    sample(s, torch.tensor([env]), torch.tensor([1]))
    assert torch.equal(s.weights, before)


def test_weights_end_at_one_and_lateral_speed_then_takes_its_finishing_range() -> None:
    s = sampler(replace(CFG, standing_probability=0.0))
    widest = 0.0
    for count in range(40):
        command, _ = draw(s, count)
        if (s.weights > 0).all():
            break
        widest = max(widest, command[:, 1].abs().max().item())
        track(s, steps=1, lin_vel=500.0, ang_vel=500.0, force=500.0, vel=500.0)
    assert (s.weights > 0).all(), "success everywhere must open every bin"
    assert widest > 0.45
    assert max(draw(s, 100 + i)[0][:, 1].abs().max().item() for i in range(10)) <= 0.4
    assert s.weights.max() == 1.0
    assert s.log()["Curriculum/command_bins_open"] == 1.0


def test_state_survives_saving() -> None:
    first, second = sampler(), sampler()
    draw(first)
    track(first, steps=WINDOW)
    second.load_state_dict(first.state_dict())
    assert torch.equal(draw(first, 1)[0], draw(second, 1)[0])
    assert torch.equal(first.weights, second.weights)
    assert first.weights.sum() > sampler().weights.sum()


def test_draws_depend_on_the_environment_not_on_who_else_draws() -> None:
    ids, counts = torch.arange(200), torch.zeros(200, dtype=torch.int64)
    together = sample(sampler(), ids, counts)[0]
    alone = sample(sampler(), ids[7:9], counts[7:9])[0]
    assert torch.equal(together[7:9], alone)


def test_an_initial_box_without_a_bin_is_refused() -> None:
    with pytest.raises(ConfigError, match="lin_vel_x"):
        sampler(replace(CFG, lin_vel_x=CommandRangeCfg(initial=(0.0, 0.01), finishing=(-0.6, 1.2))))
