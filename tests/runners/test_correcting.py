"""The stage that corrects, on the toy's robots."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from eagle_rl.config.schema import CorrectionCfg, ExperimentCfg
from eagle_rl.errors import CheckpointError, EagleWarning
from eagle_rl.evaluation.evaluate import MakeEnv
from eagle_rl.models.correction import CorrectedPolicy, Correction
from eagle_rl.runners import correcting
from eagle_rl.runners.checkpoint import load_actor, load_checkpoint, load_correction, save_checkpoint
from eagle_rl.runners.following import Followers
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.records import final_checkpoint
from eagle_rl.runners.stages import RunResult, run_experiment
from eagle_rl.runners.training import load_policy, train
from tests.runners.test_searching import StillToyEnv, make_still_env
from tests.runners.toy_run import make_toy_env, refuse, toy_experiment, toy_job

CORRECTION = CorrectionCfg(num_envs=64, num_steps=12, settling_steps=2, damping=0.5)
ROLLOUT = 64 * 12
PROBE = 3 * ROLLOUT
"""Environment steps of a probe; six looks of two commands follow it, and gains take seven rollouts before it."""
FORESIGHT = (2 + 4 * (1 + len(correcting.DAMPINGS))) * ROLLOUT
"""Environment steps of a foresight: two worlds to learn from, two to see every damping in under two commands."""


def corrected(folder: Path, probes: int = 2, **changes: float) -> tuple[ExperimentCfg, RunResult]:
    plan = toy_experiment(iterations=1, specialist_env_steps=0, correction_env_steps=probes * PROBE)
    cfg = dataclasses.replace(plan, correction=dataclasses.replace(CORRECTION, **changes))
    return cfg, run_experiment(cfg, folder / "run", make_still_env)


def errors(policy, robot: str) -> float:
    """Mean error over the steps of a trial, commands drawn anew."""
    env = make_still_env([robot], 64, None, seed=5)
    env.pin_commands(0.2 * torch.rand(64, 5, generator=torch.Generator().manual_seed(3)) - 0.1)
    found = []
    for _ in range(12):
        env.step(policy(env.get_observations()))
        found.append(env.tracking_errors().mean())
    return torch.stack(found[2:]).mean().item()


def test_a_correction_makes_robots_follow_better_and_leaves_the_network_alone(tmp_path):
    cfg, result = corrected(tmp_path)
    root = load_actor(final_checkpoint(result.run_dir, "generalist"))[0]
    for robot in cfg.robots:
        path = final_checkpoint(result.run_dir, f"round1/correct_{robot}")
        actor, correction = load_actor(path)[0], load_correction(path)
        assert all(torch.equal(x, root.state_dict()[name]) for name, x in actor.state_dict().items()), robot
        assert correction is not None
        assert errors(CorrectedPolicy(actor, correction), robot) < 0.9 * errors(root, robot), robot


def test_its_steps_are_counted(tmp_path):
    _, result = corrected(tmp_path, probes=1)
    spent = result.records["round1/correct_one"].env_steps
    assert spent == (7 + 3 + 12) * ROLLOUT + FORESIGHT


def test_no_gains_are_tuned_where_none_are_to_be_tried(tmp_path):
    _, result = corrected(tmp_path, probes=1, gain_std=0.0)
    record = result.records["round1/correct_one"]
    assert record.env_steps == (3 + 12) * ROLLOUT + FORESIGHT
    saved = load_correction(final_checkpoint(result.run_dir, "round1/correct_one"))
    assert saved is not None
    assert not saved.gains.any()


def test_what_is_foreseen_is_answered_on_top_of_all_passes(tmp_path):
    """The toys' errors follow from their joints, which a history shows; passes know the command alone."""
    results = {std: corrected(tmp_path / str(std), probes=1, foresight_std=std)[1].run_dir for std in (0.0, 0.05)}
    for robot in ("two", "three"):
        paths = {std: final_checkpoint(run, f"round1/correct_{robot}") for std, run in results.items()}
        actor = load_actor(paths[0.0])[0]
        without, foreseeing = load_correction(paths[0.0]), load_correction(paths[0.05])
        assert without is not None
        assert without.foresight is None
        assert foreseeing is not None
        assert foreseeing.foresight is not None, robot
        torch.testing.assert_close(foreseeing.weights, without.weights, msg="it comes after them")
        before, after = (errors(CorrectedPolicy(actor, each), robot) for each in (without, foreseeing))
        assert after < 0.95 * before, robot


def test_without_passes_foresight_stands_alone(tmp_path):
    _, result = corrected(tmp_path, std=0.0)
    assert result.records["round1/correct_two"].env_steps == FORESIGHT
    saved = load_correction(final_checkpoint(result.run_dir, "round1/correct_two"))
    assert saved is not None
    assert len(saved.weights) == len(saved.gains) == 0
    assert saved.foresight is not None


def test_a_foresight_that_makes_nothing_better_is_left_out(tmp_path, monkeypatch, capsys):
    foresee = correcting.foresee

    def wrong(*args):
        found = foresee(*args)
        return dataclasses.replace(found, weights=-3.0 * found.weights)

    monkeypatch.setattr(correcting, "foresee", wrong)
    _, result = corrected(tmp_path, probes=1)
    for robot in ("one", "two", "three"):
        saved = load_correction(final_checkpoint(result.run_dir, f"round1/correct_{robot}"))
        assert saved is not None
        assert saved.foresight is None, robot
    assert "with foresight left out" in capsys.readouterr().err


def followers(folder: Path, make_env: MakeEnv = make_still_env) -> tuple[Followers, Correction]:
    """Robots of the first kind, and what was found for them."""
    cfg, result = corrected(folder, probes=1)
    one = dataclasses.replace(cfg, robots=("one",), correction=dataclasses.replace(CORRECTION, upright_share=0.25))
    path = final_checkpoint(result.run_dir, "round1/correct_one")
    correction = load_correction(path)
    assert correction is not None
    return Followers(one, load_actor(path)[0], make_env, seed=1), correction


def test_a_share_of_the_robots_is_upright_whichever_commands_are_drawn(tmp_path):
    robots, correction = followers(tmp_path)
    for number in (0, 1):
        commands = robots.follow(correction, number).command
        upright = (commands[:, 3:] == 0).all(dim=1)
        assert upright.sum() == 16, "a quarter of 64"
        assert (commands[:, :3] != 0).all()


def test_half_of_who_was_upright_stays_so_when_the_command_changes(tmp_path):
    robots, correction = followers(tmp_path)
    first, second = robots.follow(correction, 0, num_commands=2).command.chunk(2)
    assert (first[:, :3] != second[:, :3]).all(), "all velocities are drawn anew"
    before, after = ((commands[:, 3:] == 0).all(dim=1) for commands in (first, second))
    assert (before.sum(), after.sum(), (before & after).sum()) == (16, 16, 8)


def test_robots_walk_from_one_command_into_the_next(tmp_path):
    lengths = []

    def make_env(robots, num_envs, task, seed, first=0):
        lengths.append(round(task.terminations.episode_length_s / 0.02))
        return StillToyEnv(num_envs, tuple(robots), seed)

    robots, correction = followers(tmp_path, make_env)
    robots.follow(correction, 0, num_commands=2)
    assert lengths[-1] > 2 * CORRECTION.num_steps, "a time-out before would put them back at rest"


class TrippingToyEnv(StillToyEnv):
    """The first robot falls at a command that is not its first, the second under its first."""

    pins = 0

    def pin_commands(self, command: torch.Tensor | None) -> None:
        super().pin_commands(command)
        self.pins += 1

    def step(self, actions: torch.Tensor):
        obs, rewards, dones, extras = super().step(actions)
        fell = torch.zeros_like(dones)
        fell[2 - self.pins] = 1
        return obs, rewards, fell, extras | {"time_outs": torch.zeros_like(dones)}


def test_who_falls_at_a_change_of_command_is_charged_for_the_second_alone(tmp_path):
    def make_env(robots, num_envs, task, seed, first=0):
        return TrippingToyEnv(num_envs, tuple(robots), seed)

    robots, correction = followers(tmp_path, make_env)
    found = robots.follow(correction, 0, num_commands=2)
    assert found.fell.nonzero().flatten().tolist() == [1, 64], "the second at once, the first under its second command"
    assert (found.cost[[1, 64]] > found.cost[[0, 65]]).all()
    rest = robots.follow(correction, 0)
    assert rest.fell.nonzero().flatten().tolist() == [1]


class SpinningToyEnv(StillToyEnv):
    """Its third joint is what the gyroscope says, and an error of its own pushes it on."""

    def step(self, actions: torch.Tensor):
        spin = self.frames[:, 0, 2] - self.command[:, 2]
        pushed = actions.clone()
        pushed[:, 2] = pushed[:, 2] + 0.5 * spin
        return super().step(pushed)


def test_gains_are_found_that_hold_a_robot_against_what_it_spins_by(tmp_path):
    plan = toy_experiment(iterations=1, specialist_env_steps=0, correction_env_steps=PROBE)
    scales = dataclasses.replace(
        plan.task.observations.scales, base_ang_vel=1.0, command=(1.0,) * 5
    )  # the toy shows its joints as they are
    observations = dataclasses.replace(plan.task.observations, scales=scales)
    cfg = dataclasses.replace(
        plan,
        task=dataclasses.replace(plan.task, observations=observations),
        correction=dataclasses.replace(CORRECTION, gain_std=0.1),
    )

    def make_env(robots, num_envs, task, seed, first=0):
        return SpinningToyEnv(num_envs, tuple(robots), seed)

    result = run_experiment(cfg, tmp_path / "run", make_env)
    for robot in cfg.robots:
        saved = load_correction(final_checkpoint(result.run_dir, f"round1/correct_{robot}"))
        assert saved is not None
        assert saved.gains[0, 2, 0] < -0.03, f"{robot}: the third joint is to be held back: {saved.gains[0, 2]}"


def test_it_is_judged_and_teaches_with_its_correction(tmp_path):
    cfg, result = corrected(tmp_path)
    path = final_checkpoint(result.run_dir, "round1/correct_two")
    stage = next(stage for stage in plan_stages(cfg) if stage.name == "round1/correct_two")
    assert isinstance(load_policy(toy_job(cfg, stage, tmp_path), path), CorrectedPolicy)
    distilled = load_checkpoint(final_checkpoint(result.run_dir, "round1/distill")).state
    assert "correction" not in distilled, "a generalist has learned what it says"


def test_a_correction_that_makes_nothing_better_is_dropped(tmp_path, monkeypatch):
    monkeypatch.setattr(correcting, "improve", lambda correction, *_: torch.full_like(correction.weights[-1], 3.0))
    _, result = corrected(tmp_path)
    path = final_checkpoint(result.run_dir, "round1/correct_one")
    saved = load_correction(path)
    assert saved is not None
    assert not saved.weights.any(), "coefficients of 3 throw any robot over"


def test_a_correction_of_another_version_is_refused_in_words(tmp_path):
    _, result = corrected(tmp_path, probes=1)
    state = load_checkpoint(final_checkpoint(result.run_dir, "round1/correct_one")).state
    del state["correction"]["gains"]
    path = save_checkpoint(tmp_path, state, Provenance(), iteration=1, env_steps=0)
    with pytest.raises(CheckpointError, match=r"another version: .*'gains'.*\. Correct it again"):
        load_correction(path)


def test_nothing_is_trained_on_from_a_corrected_specialist(tmp_path):
    """Its network alone acts otherwise than the policy it was judged as."""
    _, result = corrected(tmp_path)
    root = final_checkpoint(result.run_dir, "round1/correct_one")
    with pytest.raises(CheckpointError, match="Use the stage before the correction"):
        run_experiment(toy_experiment(method="ppo", root=str(root)), tmp_path / "on", make_toy_env)


class FallingToyEnv(StillToyEnv):
    """Robots that fall at every step, as those of an untrained policy soon do."""

    def step(self, actions: torch.Tensor):
        obs, rewards, dones, extras = super().step(actions)
        return obs, rewards, torch.ones_like(dones), extras | {"time_outs": torch.zeros_like(dones)}


def test_a_policy_that_cannot_walk_is_left_as_it_is_with_a_warning(tmp_path):
    plan = toy_experiment(iterations=1, specialist_env_steps=0, correction_env_steps=PROBE)
    cfg = dataclasses.replace(plan, correction=CORRECTION)

    def make_env(robots, num_envs, task, seed, first=0):
        return FallingToyEnv(num_envs, tuple(robots), seed)

    with pytest.warns(EagleWarning, match="a correction needs a policy that walks"):
        result = run_experiment(cfg, tmp_path / "run", make_env)
    saved = load_correction(final_checkpoint(result.run_dir, "round1/correct_one"))
    assert saved is not None
    assert not saved.weights.any()


def test_only_the_first_of_several_processes_corrects():
    cfg = toy_experiment(correction_env_steps=1)
    stage = next(stage for stage in plan_stages(cfg) if stage.kind == "correct")
    assert train(toy_job(cfg, stage, Path("stage"), refuse, rank=1)) == Path("stage/checkpoints/model_1.pt"), (
        "what the leader is going to write"
    )
