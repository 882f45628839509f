"""A run that stops and goes on is the run that did not stop."""

from __future__ import annotations

import hashlib
import io
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from eagle_rl.config.schema import (
    AidsCfg,
    CommandCurriculumCfg,
    CommandsCfg,
    RandomizationCfg,
    RewardsCfg,
    TaskCfg,
    TerminationsCfg,
)
from envs.humanoid_env import HumanoidEnv
from tests.envs.worlds import BARE, LOG_INTERVAL, actions, assert_same, make_env

EASY = CommandCurriculumCfg(
    lin_vel_threshold=0.0, ang_vel_threshold=0.0, contact_force_threshold=0.0, contact_vel_threshold=0.0
)
"""Any window that was not cut short widens the commands."""
BUSY = replace(
    TaskCfg(),
    commands=CommandsCfg(resampling_time_s=0.3, curriculum=EASY),
    rewards=RewardsCfg(penalty_interval_steps=40),
    randomization=RandomizationCfg(push_interval_s=0.34),
    terminations=TerminationsCfg(episode_length_s=0.9),
    aids=AidsCfg(harness=0.1),
)
"""Pushes, resampling, time-outs, falls and every curriculum within a second."""


def run(env: HumanoidEnv, steps: range) -> list[Any]:
    """Everything the steps return."""
    return [env.step(actions(env.num_envs, step, 3.0)) for step in steps]


def saved_and_loaded(state: dict[str, Any]) -> dict[str, Any]:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def assert_continues(make: Callable[[], HumanoidEnv], before: int, after: int) -> None:
    """N + M steps equal N steps, a file, a new environment and M steps."""
    straight, stopped = make(), make()
    run(straight, range(before))
    run(stopped, range(before))
    resumed = make()
    run(resumed, range(3))  # whatever it did before, the file decides
    resumed.load_state_dict(saved_and_loaded(stopped.state_dict()))
    assert_same(straight.get_observations(), resumed.get_observations(), "directly after loading")
    steps = range(before, before + after)
    for step, first, second in zip(steps, run(straight, steps), run(resumed, steps), strict=True):
        assert_same(first[0], second[0], f"resumed at {before}, step {step}")
        assert torch.equal(first[1], second[1]), f"rewards, resumed at {before}, step {step}"
        assert torch.equal(first[2], second[2]), "dones"
        assert_same(first[3]["final_observations"], second[3]["final_observations"], "last observations")
        logs = [{tag: float(value) for tag, value in out[3]["log"].items()} for out in (first, second)]
        assert logs[0] == logs[1], "logs"
    saved = [saved_and_loaded(env.state_dict()) for env in (straight, resumed)]
    assert flat(saved[0]) == flat(saved[1])


def flat(x: Any) -> Any:
    """Nested state as comparable lists."""
    if isinstance(x, dict):
        return {key: flat(value) for key, value in x.items()}
    if isinstance(x, list):
        return [flat(value) for value in x]
    return x.tolist() if isinstance(x, torch.Tensor) else x


@pytest.mark.parametrize("before", [1, 16, 17, 24, 40, 44, 45])
def test_an_environment_resumes_bit_for_bit(before: int) -> None:
    """In mid-episode, around pushes (17), log entries (24), a harder penalty (40) and time-outs (45)."""
    assert_continues(lambda: make_env(task=BUSY), before, 60)


def test_everything_happened_that_the_resume_test_is_about() -> None:
    env = make_env(task=BUSY)
    penalty, bins = env.penalty_scale, env.commands.sampler.weights.sum()
    outs = run(env, range(105))
    assert env.penalty_scale > penalty
    assert env.commands.sampler.weights.sum() > bins, "no window widened the commands"
    time_outs = sum(int(out[3]["time_outs"].sum()) for out in outs)
    falls = sum(int(out[2].sum()) for out in outs) - time_outs
    assert time_outs > 0
    assert falls > 0
    assert (env.commands.count > env.episode_count).all(), "commands were redrawn within an episode"


def test_resumes_without_randomization_and_in_double_precision() -> None:
    assert_continues(lambda: make_env(task=BARE, dtype=torch.float64), 30, LOG_INTERVAL)


def digest() -> str:
    """Of everything a few busy steps return."""
    sha = hashlib.sha256()
    for observations, rewards, dones, _ in run(make_env(task=BUSY), range(20)):
        for tensor in (*(observations[key] for key in sorted(observations.keys())), rewards, dones):
            sha.update(tensor.numpy().tobytes())
    return sha.hexdigest()


@pytest.mark.slow
def test_another_process_simulates_the_same_bits() -> None:
    code = "from tests.envs.test_resume import digest; print(digest())"
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONHASHSEED": "12345", "PYTHONPATH": str(root)}  # sets are ordered otherwise there
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == digest()


def test_a_state_can_be_loaded_twice() -> None:
    first = make_env(task=BUSY)
    run(first, range(20))
    state = first.state_dict()
    twins = [make_env(task=BUSY), make_env(task=BUSY)]
    outcomes = []
    for twin in twins:
        twin.load_state_dict(state)
        outcomes.append(run(twin, range(20, 60))[-1])
    assert_same(outcomes[0][0], outcomes[1][0], "the first environment wrote into the loaded state")


def test_learning_and_looking_may_take_turns() -> None:
    """Steps under ``inference_mode``, as in training, and outside of it, as in an evaluation between."""
    straight, turns = make_env(task=BUSY), make_env(task=BUSY)
    expected = run(straight, range(75))[-1]
    with torch.inference_mode():
        run(turns, range(25))
    run(turns, range(25, 50))
    with torch.inference_mode():
        outcome = run(turns, range(50, 75))[-1]
    assert_same(expected[0], outcome[0], "inference mode")
