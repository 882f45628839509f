"""Pairs of trials, on robots whose errors are known in closed form."""

from __future__ import annotations

import dataclasses
from functools import partial

import pytest
import torch
from tensordict import TensorDict

from eagle_rl.cli.environment import make_env_factory
from eagle_rl.config.schema import ExperimentCfg, RunCfg, SearchCfg, TaskCfg
from eagle_rl.evaluation.trials import PairedTrials
from tests.evaluation.fake import ScriptedEnv, idle, make_scripted_env, perfect

UNITS = (0.1, 0.2, 0.5, 0.01, 0.04)
SEARCH = SearchCfg(
    num_pairs=32, num_steps=8, settling_steps=2, resampling_time_s=0.08, standing_probability=0.25, error_units=UNITS
)
CFG = ExperimentCfg(name="x", robots=("h1",), search=SEARCH)
WORST = torch.tensor([1.2, 0.4, 1.0, 0.3, 0.5]) / torch.tensor(UNITS)
"""The largest commands there are, in units."""


def test_a_perfect_tracker_costs_nothing():
    trials = PairedTrials(CFG, make_scripted_env, 1)
    cost, fell = trials.follow(0, trials.commands(0), perfect)
    assert (cost.max().item(), fell.any().item()) == (pytest.approx(0.0, abs=1e-6), False)


def test_an_idle_robot_costs_its_commands_in_units():
    trials = PairedTrials(CFG, make_scripted_env, 1)
    commands = trials.commands(0)
    cost, _ = trials.follow(1, commands, idle)
    shares = (commands.abs() / torch.tensor(UNITS)).mean(dim=2)
    expected = (2 * shares[:, 0] + 4 * shares[:, 1]) / 6
    torch.testing.assert_close(cost, expected, msg="2 judged steps under the first command, 4 under the second")


def test_every_step_after_a_fall_costs_the_largest_commands():
    trials = PairedTrials(CFG, lambda *args: ScriptedEnv(args[1], args[2], fall_at=6), 1)
    cost, fell = trials.follow(0, trials.commands(0), perfect)
    assert fell.all()
    torch.testing.assert_close(cost, (3 / 6 * WORST.mean()).expand(32), msg="3 of 6 judged steps: 6, 7 and 8")


def test_each_number_has_commands_of_its_own_and_a_share_of_them_stands():
    trials = PairedTrials(CFG, make_scripted_env, 1)
    first, second = trials.commands(0), trials.commands(1)
    assert first.shape == (32, 2, 5)
    assert not torch.equal(first, second)
    assert torch.equal(first, PairedTrials(CFG, make_scripted_env, 1).commands(0))
    many = torch.cat([trials.commands(i) for i in range(40)])
    stands = (many[..., :3] == 0).all(dim=2)
    assert stands.float().mean().item() == pytest.approx(0.25, abs=0.03)
    assert (many[..., 3:] != 0).all(), "who stands squats and leans all the same"


@pytest.mark.parametrize("share", [0.0, 0.34, 1.0])
def test_both_lots_of_a_real_robot_end_a_trial_alike_however_often(share):
    search = dataclasses.replace(SEARCH, num_pairs=3, num_steps=30, resampling_time_s=0.3, randomized_share=share)
    cfg = dataclasses.replace(CFG, search=search)
    trials = PairedTrials(cfg, make_env_factory(RunCfg(num_threads=1)), 1)

    def shake(obs: TensorDict, size: float) -> torch.Tensor:
        return size * torch.sin(torch.arange(32.0)) * obs["slot_mask"] + 0.1 * obs["history"][:, :32]

    trials.follow(0, trials.commands(9), partial(shake, size=0.1))
    for number in range(2):
        cost, _ = trials.compare(trials.commands(number), 2 * (partial(shake, size=0.2),))
        assert torch.equal(*cost), f"trial {number}: nothing but the policy may differ"
    cost, _ = trials.compare(trials.commands(2), (partial(shake, size=0.3), partial(shake, size=0.2)))
    assert not torch.equal(*cost)


def test_a_fall_in_one_lot_leaves_both_in_the_same_world():
    """Who falls starts again, with friction, motors and a stance of its own."""
    search = dataclasses.replace(SEARCH, num_pairs=2, num_steps=30, resampling_time_s=0.0, randomized_share=1.0)
    trials = PairedTrials(dataclasses.replace(CFG, search=search), make_env_factory(RunCfg(num_threads=1)), 1)

    still, flailing = ((lambda obs, size=size: size * obs["slot_mask"]) for size in (0.0, 5.0))
    _, fell = trials.compare(trials.commands(0), (still, flailing))
    assert fell.any(dim=1).tolist() == [False, True]
    cost, _ = trials.compare(trials.commands(1), (still, still))
    assert torch.equal(*cost)


def test_a_share_of_the_pairs_is_in_the_world_of_training():
    worlds = []

    def make_env(robots: object, num_envs: int, task: TaskCfg, seed: int, first: int = 0) -> ScriptedEnv:
        worlds.append((num_envs, task.randomization.enabled, task.observations.enable_corruption))
        return ScriptedEnv(num_envs, task)

    search = dataclasses.replace(SEARCH, randomized_share=0.25)
    trials = PairedTrials(dataclasses.replace(CFG, search=search), make_env, 1)
    assert worlds == 2 * [(24, False, False), (8, True, True)]
    commands = trials.commands(0)
    assert len(trials.observations()) == 32
    cost, fell = trials.follow(0, commands, perfect)
    assert cost.shape == fell.shape == (32,)
    torch.testing.assert_close(cost, torch.zeros(32), atol=1e-6, rtol=0, msg="each follows the command it is given")


def test_a_mirror_image_swaps_sides_and_is_its_own_inverse():
    search = dataclasses.replace(SEARCH, num_pairs=4, randomized_share=0.5)
    trials = PairedTrials(dataclasses.replace(CFG, search=search), make_env_factory(RunCfg(num_threads=1)), 1)
    trials.follow(0, trials.commands(0), lambda obs: 0.3 * torch.sin(torch.arange(32.0)) * obs["slot_mask"])
    obs = trials.observations()
    image = trials.mirrored(obs)
    sides = torch.tensor([1.0, -1.0, -1.0, 1.0, 1.0])
    torch.testing.assert_close(image["command"], obs["command"] * sides, msg="v_y and omega change sign")
    assert not torch.equal(image["history"], obs["history"])
    twice = trials.mirrored(image)
    assert all(torch.equal(twice[name], obs[name]) for name in ("history", "command", "clock", "slot_mask"))
