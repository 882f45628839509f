"""Commands of an evaluation."""

from __future__ import annotations

import dataclasses

import torch
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.config.schema import CommandsCfg, EvaluationCfg, TaskCfg, TerrainCfg
from eagle_rl.evaluation.protocol import COMMANDS, draw_commands, drawn_commands, evaluation_task, judged_commands

CFG = CommandsCfg()
EV = EvaluationCfg(num_steps=400, resampling_time_s=4.0)


@given(few=st.integers(1, 50), more=st.integers(0, 50))
def test_more_environments_move_nobody_elses_commands(few, more):
    assert torch.equal(draw_commands(CFG, EV, "h1", few), draw_commands(CFG, EV, "h1", few + more)[:few])


@given(seed=st.integers(0, 2**31), protocol=st.sampled_from(["single", "joint", "upright", "standing"]))
def test_commands_stay_in_the_finishing_ranges_and_others_are_zero(seed, protocol):
    ev = dataclasses.replace(EV, seed=seed, protocol=protocol)
    commands = draw_commands(CFG, ev, "g1", 40)
    assert commands.shape == (40, 2, 5)
    for d, name in enumerate(COMMANDS):
        low, high = getattr(CFG, name).finishing
        assert ((commands[..., d] >= low) & (commands[..., d] <= high)).all()
    assert ((commands == 0) == ~drawn_commands(ev, 40)).all()


def test_single_splits_the_environments_evenly_over_the_commands():
    ev = EvaluationCfg(protocol="single")
    judged = judged_commands(ev, 100)
    assert (judged.sum(0) == 20).all()
    assert (judged.sum(1) == 1).all()
    assert torch.equal(drawn_commands(ev, 100), judged.unsqueeze(1))


def test_upright_holds_every_posture_at_exactly_zero_and_judges_all_five():
    ev = EvaluationCfg(protocol="upright")
    commands = draw_commands(CFG, ev, "h1", 50)
    assert (commands[..., 3:] == 0).all()
    assert (commands[..., :3] != 0).all()
    assert judged_commands(ev, 50).all()


def test_standing_holds_every_velocity_at_exactly_zero_and_judges_all_five():
    ev = EvaluationCfg(protocol="standing")
    commands = draw_commands(CFG, ev, "h1", 50)
    assert (commands[..., :3] == 0).all()
    assert (commands[..., 3:] != 0).all()
    assert judged_commands(ev, 50).all()


def test_redrawn_standing_alternates_with_walking_and_half_of_the_robots_stand_at_any_time():
    commands = draw_commands(CFG, dataclasses.replace(EV, protocol="standing", num_steps=1000), "h1", 50)
    standing = (commands[..., :3] == 0).all(-1)
    assert standing.shape == (50, 5)
    assert (standing[:, 1:] != standing[:, :-1]).all()
    assert (standing.sum(0) == 25).all()


def test_robots_and_seeds_draw_different_commands():
    drawn = [
        draw_commands(CFG, dataclasses.replace(EV, seed=seed), robot, 4) for seed in (1, 2) for robot in ("h1", "g1")
    ]
    assert len({tuple(d.flatten().tolist()) for d in drawn}) == 4


def test_policies_are_judged_on_flat_ground_without_help_or_disturbance():
    trained = TaskCfg(terrain=TerrainCfg(kind="steps"))
    task = evaluation_task(trained, EV)
    assert task.terrain.kind == "plane"
    assert not task.randomization.enabled
    assert not task.observations.enable_corruption
    assert task.aids.harness == task.aids.gait_shaping == 0.0
    assert task.terminations.episode_length_s > EV.num_steps * 0.02
    assert task.rewards.weights == trained.rewards.weights
