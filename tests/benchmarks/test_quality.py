"""The benchmark of training time, on a handful of environments for a handful of steps."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from benchmarks import quality
from benchmarks.quality import Check, quality_experiment, time_to_quality
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import CheckpointError
from eagle_rl.evaluation.metrics import RobotMetrics, TrackingErrors


@pytest.fixture
def cfg() -> ExperimentCfg:
    overrides = ["algo.num_steps_per_env=4", "plan.generalist_env_steps=96", "algo.network.critic_dims=[32]"]
    cfg = quality_experiment(8, 1, overrides)
    return replace(cfg, evaluation=replace(cfg.evaluation, num_envs_per_robot=2, num_steps=5))


@pytest.mark.parametrize(("survival", "error", "good"), [(0.95, 0.2, True), (0.94, 0.1, False), (1.0, 0.21, False)])
def test_a_policy_is_good_when_it_stays_up_and_follows(survival, error, good):
    assert Check(env_steps=1, seconds=1.0, survival=survival, error_vx=error).good is good


def test_a_run_that_ran_out_of_time_goes_on_where_it_was(cfg, tmp_path, monkeypatch):
    monkeypatch.setattr(quality, "MAX_ERROR_VX", 0.0)  # never good
    steps = []
    for _ in range(4):
        million, seconds = time_to_quality(cfg, tmp_path, minutes=0.0, env_steps_per_robot=1)
        steps.append(round(1e6 * million.value))
        assert "NOT YET" in seconds.detail
    assert steps == [32, 64, 96, 96], "one check at a time, and none beyond the budget"
    checks = [json.loads(line) for line in (tmp_path / "quality.jsonl").read_text().splitlines()]
    assert [check["env_steps"] for check in checks] == [32, 64, 96]
    assert checks[0]["seconds"] < checks[1]["seconds"] < checks[2]["seconds"]


def test_looks_are_as_far_apart_whatever_the_batch_and_the_fleet(cfg, tmp_path, monkeypatch):
    monkeypatch.setattr(quality, "MAX_ERROR_VX", 0.0)  # never good
    fleet = replace(cfg, robots=("g1", "h1"))
    looks = [time_to_quality(c, tmp_path / c.robots[-1], minutes=0.0, env_steps_per_robot=40) for c in (cfg, fleet)]
    assert [round(1e6 * million.value) for million, _ in looks] == [64, 96], "two and three iterations of 32 steps"


def test_a_fleet_is_as_good_as_its_worst_robot(cfg, tmp_path, monkeypatch):
    def robot(survival, error):
        tracking = TrackingErrors(share=1.0, errors=(error,) * 5, charged=(error,) * 5)
        return RobotMetrics(num_envs=2, survival=survival, upright=survival, subsets={"all": tracking})

    fleet = {"g1": robot(0.96, 0.1), "h1": robot(0.9, 0.3), "t1": robot(0.0, None)}
    for judged, told in ((("g1", "h1"), "survival 90.0%, E_vx 0.300"), (fleet, "survival 0.0%, E_vx 0.300")):
        monkeypatch.setattr(quality, "evaluate", lambda *_, judged=judged: {name: fleet[name] for name in judged})
        _, seconds = time_to_quality(cfg, tmp_path / f"{len(judged)}", minutes=0.0, env_steps_per_robot=1)
        assert told in seconds.detail


def test_a_good_policy_is_not_trained_further(cfg, tmp_path, monkeypatch):
    monkeypatch.setattr(quality, "MIN_SURVIVAL", 0.0)
    monkeypatch.setattr(quality, "MAX_ERROR_VX", 100.0)
    for _ in range(2):
        million, _ = time_to_quality(cfg, tmp_path, minutes=1.0, env_steps_per_robot=1)
        assert round(1e6 * million.value) == 32


def test_another_experiment_does_not_go_on_with_the_run(cfg, tmp_path):
    time_to_quality(cfg, tmp_path, minutes=0.0, env_steps_per_robot=1)
    with pytest.raises(CheckpointError, match="seed"):
        time_to_quality(replace(cfg, seed=2), tmp_path, minutes=0.0, env_steps_per_robot=1)
