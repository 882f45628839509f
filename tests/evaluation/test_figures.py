"""Figures and the numbers behind them."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from eagle_rl.config.schema import CommandsCfg, EvaluationCfg, TaskCfg
from eagle_rl.errors import ConfigError
from eagle_rl.evaluation import latents, plots
from eagle_rl.evaluation.curves import RoundScores, curves_to_csv, read_curves, read_rounds
from eagle_rl.evaluation.evaluate import EvaluationResult, evaluate
from eagle_rl.evaluation.latents import Embeddings
from eagle_rl.evaluation.protocol import finishing_ranges
from eagle_rl.evaluation.response import command_responses, script
from eagle_rl.evaluation.robustness import BODIES, DISTURBANCES, NOMINAL, sweep
from tests.evaluation.fake import ScriptedEnv, idle, make_scripted_env, perfect


def clusters(distance: float) -> Embeddings:
    """Three robots whose embeddings are ``distance`` standard deviations apart."""
    rng = np.random.default_rng(0)
    robot = np.repeat(np.arange(3), 80)
    features = rng.normal(size=(240, 8)) + distance * np.eye(8)[robot]
    return Embeddings(robots=("a", "b", "c"), features=features.astype(np.float32), robot=robot, env=np.arange(240))


def test_well_separated_robots_score_near_one_and_mixed_ones_near_chance():
    apart, mixed = clusters(200.0), clusters(0.0)
    assert latents.silhouette(apart) > 0.9
    assert latents.probe_accuracy(apart) == 1.0
    assert abs(latents.silhouette(mixed)) < 0.05
    assert latents.probe_accuracy(mixed) < 0.5


def test_one_robot_alone_cannot_be_told_apart():
    lonely = clusters(1.0)
    only = Embeddings(robots=lonely.robots, features=lonely.features[:80], robot=lonely.robot[:80], env=lonely.env[:80])
    with pytest.raises(ConfigError, match="1 of 3"):
        latents.silhouette(only)


class WalkingEnv(ScriptedEnv):
    """A walker, of which the first falls at step 7."""

    def step(self, actions):
        obs, rewards, dones, extras = super().step(actions)
        dones[0] = self.t == 7
        return obs, rewards, dones, extras


class Walker:
    """Embeds the command and its own number of calls."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, obs: TensorDict) -> torch.Tensor:
        self.calls += 1
        self.embedding = torch.cat([obs["command"], torch.full((len(obs), 1), float(self.calls))], dim=1)
        return idle(obs)


def test_embeddings_are_those_of_robots_still_walking_forward():
    found = latents.collect_embeddings(
        Walker(),
        lambda robots, n, task, seed: WalkingEnv(n, task),
        ["a", "b"],
        TaskCfg(),
        EvaluationCfg(),
        num_envs=3,
        warm_up_steps=4,
        num_samples=2,
        stride=4,
    )
    assert found.robot.tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 1, 1]
    assert found.env.tolist() == [0, 1, 2, 1, 2] * 2
    np.testing.assert_allclose(found.features[:, :5], np.tile(latents.WALK_FORWARD, (10, 1)), rtol=1e-6)


@pytest.mark.parametrize("env", [[0, 1, 0, 0], [0, 0, 0, 0]])
def test_a_robot_that_walked_in_one_half_of_its_environments_alone_is_named(env):
    """The probe would not know it, or never be asked for it."""
    robot, features = np.array([0, 0, 1, 1]), np.eye(4, dtype=np.float32)
    few = Embeddings(robots=("a", "b"), features=features, robot=robot, env=np.array(env))
    with pytest.raises(ConfigError, match=r"b walked in one half alone.*at least 2 environments"):
        latents.probe_accuracy(few)


def test_the_script_visits_both_limits_of_every_command():
    levels = script(CommandsCfg(), 2)
    assert levels.shape == (8, 5)
    assert levels.max(0).tolist() == [1.2, 0.4, 1.0, 0.0, 0.5]
    assert levels.min(0).tolist() == [-0.6, -0.4, -1.0, -0.3, -0.3]


class MeasuringEnv(ScriptedEnv):
    def measured_commands(self) -> torch.Tensor:
        return self.measured


def test_a_perfect_tracker_answers_with_the_command_until_it_falls():
    def falls(robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first: int = 0) -> MeasuringEnv:
        return MeasuringEnv(num_envs, task, fall_at=500)

    response = command_responses(perfect, falls, ["a"], TaskCfg(), EvaluationCfg())[0]
    np.testing.assert_allclose(response.measured[:499], response.commanded[:499], atol=1e-6)
    assert np.isnan(response.measured[499:]).all()


@pytest.mark.parametrize("through", [*DISTURBANCES.values(), *BODIES.values()], ids=lambda sweep: sweep.label)
def test_a_sweep_changes_one_thing_and_passes_through_the_nominal_world(through):
    nominal = [v for v in through.values if through.apply(v) == NOMINAL]
    assert len(nominal) == 1, f"{through.label} must contain the nominal world once"
    seen = []

    def spy(robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first: int = 0) -> ScriptedEnv:
        seen.append(task.randomization)
        return ScriptedEnv(num_envs, task)

    ev = EvaluationCfg(num_envs_per_robot=2, num_steps=1)
    scores = sweep(perfect, spy, ["a"], TaskCfg(), ev, through)
    assert seen == [through.apply(v) for v in through.values]
    assert [scores[v]["a"].survival for v in through.values] == [1.0] * len(seen)


def test_curves_are_read_per_robot_and_smoothed(tmp_path):
    path = tmp_path / "metrics.jsonl"
    rows = [{"iteration": i, "Perf/env_steps": 10 * i, "Metrics/E_vx/h1": float(i)} for i in range(1, 5)]
    rows[3]["Metrics/E_vx/g1"] = "nan"
    path.write_text("\n".join(map(json.dumps, rows)) + '\n{"iterat')
    panels = read_curves(path, smoothing=2)
    (curve,) = panels["$E_{v_x}$ [m/s]"]
    assert (curve.robot, curve.env_steps, curve.values) == ("h1", (20, 40), (1.5, 3.5))


def test_curves_survive_their_csv(tmp_path):
    metrics, table = tmp_path / "metrics.jsonl", tmp_path / "curves.csv"
    rows = [{"Perf/env_steps": 10 * i, "Metrics/E_vx/h1": i / 8, "Curriculum/harness/h1": 1.0} for i in range(1, 5)]
    rows[2]["Metrics/E_vx/g1"] = 0.5
    metrics.write_text("\n".join(map(json.dumps, rows)))
    panels = read_curves(metrics)
    table.write_text(curves_to_csv(panels))
    assert read_curves(table) == panels


def judged(tmp_path, name: str, robots: list[str]):
    ev = EvaluationCfg(num_envs_per_robot=5, num_steps=1)
    metrics = evaluate(idle, make_scripted_env, robots, TaskCfg(), ev)
    path = tmp_path / name
    path.write_text(EvaluationResult(checkpoint="0", protocol=ev, robots=metrics, seed=0).to_json())
    return path


def test_every_judged_stage_stands_at_its_position_with_each_of_its_robots(tmp_path):
    scores = read_rounds(
        [
            (0.0, False, judged(tmp_path, "generalist.json", ["h1", "g1"])),
            (0.5, True, judged(tmp_path, "h1.json", ["h1"])),
            (1.0, False, judged(tmp_path, "distill.json", ["h1", "g1"])),
        ]
    )
    assert [(s.robot, s.position) for s in scores] == [("h1", 0), ("g1", 0), ("h1", 0.5), ("h1", 1), ("g1", 1)]


def test_figures_are_written_as_png_and_pdf(tmp_path):
    embeddings = clusters(5.0)
    score = RoundScores(robot="h1", specialist=False, position=0.0, errors=(0.1,) * 5)
    ev = EvaluationCfg(num_envs_per_robot=2, num_steps=1)
    swept = sweep(perfect, make_scripted_env, ["h1"], TaskCfg(), ev, DISTURBANCES["push"])
    figures = {
        "latents": plots.latent_maps({"PPO": (embeddings, np.zeros((240, 2), dtype=np.float32), 0.5, 0.9)}),
        "rounds": plots.error_rounds([score]),
        "robustness": plots.robustness([(DISTURBANCES["push"], swept)], ev, finishing_ranges(CommandsCfg())),
    }
    assert "silhouette 0.50, linear probe 90.0%" in figures["latents"].axes[0].get_title()
    for name, figure in figures.items():
        for path in plots.save(figure, tmp_path, name):
            assert path.stat().st_size > 1000
    assert {path.suffix for path in tmp_path.iterdir()} == {".png", ".pdf"}
