"""The benchmark of training time, on a handful of environments for a handful of steps."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from benchmarks import quality
from benchmarks.quality import Check, quality_experiment, time_to_quality
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import CheckpointError


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
        million, seconds = time_to_quality(cfg, tmp_path, minutes=0.0, iterations=1)
        steps.append(round(1e6 * million.value))
        assert "NOT YET" in seconds.detail
    assert steps == [32, 64, 96, 96], "one check at a time, and none beyond the budget"
    checks = [json.loads(line) for line in (tmp_path / "quality.jsonl").read_text().splitlines()]
    assert [check["env_steps"] for check in checks] == [32, 64, 96]
    assert checks[0]["seconds"] < checks[1]["seconds"] < checks[2]["seconds"]


def test_a_good_policy_is_not_trained_further(cfg, tmp_path, monkeypatch):
    monkeypatch.setattr(quality, "MIN_SURVIVAL", 0.0)
    monkeypatch.setattr(quality, "MAX_ERROR_VX", 100.0)
    for _ in range(2):
        million, _ = time_to_quality(cfg, tmp_path, minutes=1.0, iterations=1)
        assert round(1e6 * million.value) == 32


def test_another_experiment_does_not_go_on_with_the_run(cfg, tmp_path):
    time_to_quality(cfg, tmp_path, minutes=0.0, iterations=1)
    with pytest.raises(CheckpointError, match="seed"):
        time_to_quality(replace(cfg, seed=2), tmp_path, minutes=0.0, iterations=1)
