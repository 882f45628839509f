"""The protocol judged by policies whose scores have closed forms."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.config.schema import CommandRangeCfg, CommandsCfg, EvaluationCfg, TaskCfg
from eagle_rl.evaluation.evaluate import EvaluationResult, evaluate
from eagle_rl.evaluation.metrics import RobotMetrics
from eagle_rl.evaluation.protocol import finishing_ranges
from eagle_rl.evaluation.reference import floors
from tests.evaluation.fake import ScriptedEnv, idle, make_scripted_env, perfect

ROOT = Path(__file__).parents[2]
RANGES = finishing_ranges(CommandsCfg())
FLOORS = (0.50, 0.20, 0.50, 0.15, 0.2125)
"""Mean |c_d| of U[-.6, 1.2], U[-.4, .4], U[-1, 1], U[-.3, 0], U[-.3, .5]."""

EV = EvaluationCfg(num_envs_per_robot=4000, num_steps=4)


def run(policy, make_env=make_scripted_env, ev=EV, **kwargs) -> RobotMetrics:
    return evaluate(policy, make_env, ["h1"], TaskCfg(), ev, **kwargs)["h1"]


@pytest.mark.parametrize("protocol", ["single", "joint", "upright", "standing"])
def test_a_perfect_tracker_scores_zero(protocol):
    metrics = run(perfect, ev=dataclasses.replace(EV, protocol=protocol))
    assert metrics.survival == 1.0
    assert metrics.subsets["all"].errors == pytest.approx((0,) * 5, abs=1e-7)


def constantly(*measured: float) -> Callable[[TensorDict], Tensor]:
    """A policy that measures the same whatever is commanded."""
    return lambda obs: torch.nn.functional.pad(torch.tensor(measured).expand(len(obs), 5), (0, 27))


@pytest.mark.parametrize(
    ("protocol", "resampling_time_s", "floor"),
    [
        ("single", 0.0, (0.50, 0.20, 0.50, 0.15, 0.2125)),
        ("joint", 0.0, (0.50, 0.20, 0.50, 0.15, 0.2125)),
        ("joint", 0.02, (0.50, 0.20, 0.50, 0.15, 0.2125)),
        ("upright", 0.0, (0.50, 0.20, 0.50, 0.0, 0.0)),
        ("standing", 0.0, (0.0, 0.0, 0.0, 0.15, 0.2125)),
        ("standing", 0.02, (0.25, 0.10, 0.25, 0.15, 0.2125)),
    ],
)
def test_an_idle_robot_scores_the_closed_form_floors(protocol, resampling_time_s, floor):
    ev = dataclasses.replace(EV, protocol=protocol, resampling_time_s=resampling_time_s)
    assert floors(ev, RANGES)["stand still"] == pytest.approx(floor)
    assert run(idle, ev=ev).subsets["all"].errors == pytest.approx(floor, rel=0.05)


@pytest.mark.parametrize(
    ("protocol", "forward", "posture"),
    [("joint", 0.3, (-0.15, 0.1)), ("upright", 0.3, (0.0, 0.0)), ("standing", 0.0, (-0.15, 0.1))],
)
def test_the_best_constant_scores_its_closed_form(protocol, forward, posture):
    ev = dataclasses.replace(EV, protocol=protocol)
    metrics = run(constantly(forward, 0.0, 0.0, *posture), ev=ev)
    assert metrics.subsets["all"].errors == pytest.approx(floors(ev, RANGES)["best constant"], rel=0.05)


@pytest.mark.parametrize("forward", [(0.0, 0.3), (-0.9, -0.2), (-0.1, 0.7), (0.4, 0.4)])
def test_floors_are_of_the_ranges_in_force(forward):
    commands = CommandsCfg(lin_vel_x=CommandRangeCfg(initial=forward, finishing=forward))
    own, task = floors(EV, finishing_ranges(commands)), TaskCfg(commands=commands)
    middle = constantly(sum(forward) / 2, 0.0, 0.0, -0.15, 0.1)
    for name, policy in (("stand still", idle), ("best constant", middle)):
        scored = evaluate(policy, make_scripted_env, ["h1"], task, EV)["h1"].subsets["all"].errors
        assert scored == pytest.approx(own[name], rel=0.05, abs=1e-6)


def test_a_robot_that_drifts_while_it_should_stand_is_charged_its_speed():
    ev = dataclasses.replace(EV, protocol="standing")
    errors = run(constantly(0.1, -0.2, 0.3, 0.0, 0.0), ev=ev).subsets["standing"].errors
    assert errors[:3] == pytest.approx((0.1, 0.2, 0.3))


def test_after_a_fall_own_errors_stop_and_charged_errors_are_those_of_standing_still():
    def falls_in_third_step(robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first: int) -> ScriptedEnv:
        return ScriptedEnv(num_envs, task, fall_at=3)

    metrics = run(perfect, falls_in_third_step)
    assert metrics.survival == 0.0
    assert metrics.upright == pytest.approx(0.5)
    assert metrics.subsets["all"].errors == pytest.approx((0,) * 5, abs=1e-7)
    assert metrics.subsets["all"].charged == pytest.approx([0.5 * floor for floor in FLOORS], rel=0.05)


def test_a_fall_in_the_first_step_leaves_no_own_errors_but_the_whole_charge():
    metrics = run(idle, lambda robots, n, task, seed, first: ScriptedEnv(n, task, fall_at=1))
    assert metrics.subsets["all"].errors == (None,) * 5
    assert metrics.subsets["all"].charged == pytest.approx(FLOORS, rel=0.05)


def noisy(obs: TensorDict) -> Tensor:
    """A network whose rounding may depend on how many rows it sees."""
    hidden = torch.tanh(obs["command"] @ torch.linspace(-1, 1, 5 * 64).view(5, 64))
    return hidden @ torch.linspace(-1, 1, 64 * 32).view(64, 32)


def test_the_result_does_not_depend_on_the_chunk_size():
    ev = dataclasses.replace(EV, num_envs_per_robot=700)
    results = [run(noisy, ev=ev, chunk_envs=chunk) for chunk in (128, 512, 10_000)]
    assert results[0] == results[1] == results[2]


def test_subsets_cover_what_their_names_say():
    subsets = run(perfect).subsets
    assert subsets["standing"].share + subsets["walking"].share == pytest.approx(1.0)
    assert subsets["squatting"].share == pytest.approx(0.5, abs=0.03)
    assert subsets["leaning"].share == pytest.approx((0.1 + 0.3) / 0.8, abs=0.03)
    assert subsets["settled"].share == 0.0


def test_settled_steps_begin_one_second_after_each_new_command():
    ev = EvaluationCfg(num_envs_per_robot=8, num_steps=120, resampling_time_s=1.2)
    assert run(perfect, ev=ev).subsets["settled"].share == pytest.approx(20 / 120)


def test_the_task_of_an_evaluation_has_no_aids_noise_or_time_out():
    seen = []

    def spy(robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first: int) -> ScriptedEnv:
        seen.append(task)
        return ScriptedEnv(num_envs, task)

    run(perfect, spy)
    task = seen[0]
    assert (task.aids.harness, task.aids.gait_shaping) == (0.0, 0.0)
    assert not task.commands.curriculum.enabled
    assert not task.randomization.enabled
    assert not task.observations.enable_corruption
    assert task.terminations.episode_length_s > EV.num_steps * 0.02
    assert (task.sim.physics_dt, task.sim.decimation) == (0.005, 4)


def test_a_result_survives_its_json():
    metrics = evaluate(perfect, make_scripted_env, ["h1", "g1"], TaskCfg(), EV)
    narrow = ((0.0, 0.3), *RANGES[1:])
    result = EvaluationResult(checkpoint="0" * 64, protocol=EV, robots=metrics, seed=3, unseen=("g1",), ranges=narrow)
    assert EvaluationResult.from_json(result.to_json()) == result


def test_a_stored_result_that_does_not_say_its_ranges_has_the_default_ones():
    stored = [EvaluationResult.read(path) for path in (ROOT / "docs/results").rglob("*_seed*.json")]
    assert {result.ranges for result in stored} == {RANGES}
