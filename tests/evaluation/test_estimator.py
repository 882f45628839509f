"""The estimator's report, against closed forms."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from eagle_rl.config.schema import EvaluationCfg, RandomizationCfg, TaskCfg
from eagle_rl.errors import ConfigError
from eagle_rl.evaluation import plots
from eagle_rl.evaluation.estimator import Channel, Moments, Sampled, judge_estimator, report
from eagle_rl.evaluation.estimator_report import describe, to_csv, to_markdown
from tests.evaluation.fake import ScriptedEnv, idle
from tests.runners.toy_run import refuse

SPEED = Channel(name="base v_x", unit="m/s", scale=0.5)
MASS = Channel(name="torso mass", unit="kg", scale=4.0)


@given(parts=st.lists(st.integers(0, 7), min_size=1, max_size=6), centre=st.sampled_from([0.0, 1.0, 1e6]))
def test_moments_in_parts_are_those_of_the_whole_even_far_from_zero(parts, centre):
    values = centre + torch.randn(sum(parts) + 2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moments = Moments(3)
    for part in values.split([*parts, 2]):
        moments.add(part)
    whole = values.numpy()
    assert moments.count == len(whole)
    np.testing.assert_allclose(moments.mean, whole.mean(0), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(moments.squares, len(whole) * whole.var(0), rtol=1e-6)
    np.testing.assert_allclose(moments.mean_square, (whole**2).mean(0), rtol=1e-12)


def sampled(estimate: torch.Tensor, target: torch.Tensor) -> Sampled:
    both = Sampled(target.shape[1])
    both.add(estimate, target)
    return both


def spread(mean: float, std: float) -> torch.Tensor:
    """Two columns of exactly this mean and standard deviation."""
    return torch.tensor([[mean - std] * 2, [mean + std] * 2] * 50, dtype=torch.float64)


def test_an_estimate_that_shrinks_the_target_leaves_the_square_of_the_rest_unexplained():
    target = spread(0.0, 2.0)
    score = report({"a": sampled(0.7 * target, target)}, (SPEED, MASS)).robots["a"]
    assert [s.explained for s in score] == pytest.approx([1 - 0.3**2] * 2)
    assert [s.rmse for s in score] == pytest.approx([0.5 * 0.6, 4.0 * 0.6])
    assert [s.prior for s in score] == pytest.approx([0.5 * 2.0, 4.0 * 2.0])


def test_a_constant_bias_is_explained_but_counts_as_error():
    target = spread(0.0, 1.0)
    (score, _) = report({"a": sampled(target + 3.0, target)}, (SPEED, MASS)).robots["a"]
    assert score.explained == pytest.approx(1.0)
    assert score.rmse == pytest.approx(0.5 * 3.0)


def test_knowing_the_robot_explains_the_fleet_and_nothing_within_it():
    targets = {"a": spread(-3.0, 1.0), "b": spread(3.0, 1.0)}
    guesses = {name: target.mean(dim=0).expand_as(target) for name, target in targets.items()}
    found = report({name: sampled(guesses[name], targets[name]) for name in targets}, (SPEED, MASS))
    assert found.fleet[0].explained == pytest.approx(9.0 / 10.0)
    assert found.within[0].explained == pytest.approx(0.0)
    assert found.within[0].rmse == pytest.approx(found.within[0].prior), "the robot's mean is the prior's answer"
    assert found.fleet[0].prior == pytest.approx(0.5 * 10**0.5)


def test_a_target_that_does_not_vary_has_no_explained_variance():
    target = torch.zeros(10, 2)
    found = report({"a": sampled(target + 0.1, target)}, (SPEED, MASS))
    assert found.within[0].explained is None
    assert "| base v_x | - | - | - |" in to_markdown(found, "")


def test_what_varies_too_little_to_matter_in_the_loss_is_not_explained_and_other_numbers_stay():
    target = torch.cat((spread(0.0, 0.09)[:, :1], spread(0.0, 0.11)[:, :1]), dim=1)
    little, enough = report({"a": sampled(target + 9.0 * target, target)}, (SPEED, MASS)).within
    assert little.explained is None
    assert enough.explained == pytest.approx(1.0 - 9.0**2)
    assert (little.prior, little.rmse) == pytest.approx((0.5 * 0.09, 0.5 * 9 * 0.09))


def test_too_few_steps_for_a_sample_are_refused_with_the_number_that_will_do():
    with pytest.raises(ConfigError, match=r"--steps 50 is 1 s; sampling begins after 1 s, give at least 51\."):
        judge_estimator(HalfBlind(), refuse, ["a"], TaskCfg(), EvaluationCfg(num_steps=50), (SPEED, MASS))


def test_nobody_left_standing_is_an_error_in_words():
    with pytest.raises(ConfigError, match="first second"):
        report({"a": Sampled(2)}, (SPEED, MASS))


class Estimating(ScriptedEnv):
    """Shows a body that differs by environment, and a speed that differs by step; environment 0 falls at step 60."""

    def get_observations(self) -> TensorDict:
        obs = super().get_observations()
        speed = torch.full((self.num_envs,), float(self.t % 7))
        obs["estimate"] = torch.stack([speed, torch.arange(self.num_envs) / 2, torch.full_like(speed, 9.0)], dim=1)
        return obs

    def step(self, actions):
        obs, rewards, dones, extras = super().step(actions)
        dones[0] = self.t == 60
        return obs, rewards, dones, extras


class HalfBlind:
    """Knows the speed and guesses the body."""

    def __call__(self, obs: TensorDict) -> torch.Tensor:
        self.estimate = obs["estimate"] * torch.tensor([1.0, 0.0, 1.0])
        return idle(obs)


def test_a_rollout_is_sampled_from_the_first_second_until_the_fall_in_the_whole_randomized_world():
    seen = []

    def make_env(robots, num_envs, task, seed, first=0):
        seen.append(task)
        return Estimating(num_envs, task)

    task = TaskCfg(randomization=RandomizationCfg(enabled=False, link_mass_scale=(1.0, 1.0)))
    ev = EvaluationCfg(num_envs_per_robot=3, num_steps=71)
    found = judge_estimator(HalfBlind(), make_env, ["a"], task, ev, (SPEED, MASS))
    assert found.samples == {"a": 3 + 2 * 2}, "step 50 of three environments, 60 and 70 of the two that stand"
    assert found.robots["a"][0].explained == pytest.approx(1.0)
    assert found.robots["a"][1].explained == pytest.approx(0.0)
    assert seen[0].randomization == RandomizationCfg()
    assert seen[0].observations.enable_corruption


def test_table_csv_and_figure_show_every_channel():
    target = spread(0.0, 1.0)
    found = report({"a": sampled(0.5 * target, target), "b": sampled(-target, target)}, (SPEED, MASS))
    assert "| torso mass | -1.12 | -1.12 | 0.75 | -3.00 |" in to_markdown(found, describe(1, 2, 3, "f" * 64))
    rows = list(csv.DictReader(io.StringIO(to_csv(found))))
    assert [(row["robots"], row["channel"]) for row in rows[:3]] == [
        ("fleet", "base v_x"),
        ("fleet", "torso mass"),
        ("within", "base v_x"),
    ]
    axes = plots.estimator_bars(found).axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["base v_x", "torso mass"]
