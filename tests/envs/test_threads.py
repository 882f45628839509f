"""Physics in several threads: they share out all there is to do, and nobody can tell from the results how many."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from eagle_rl.machine import usable_cores
from envs.humanoid_env import HumanoidEnv
from envs.sim.fault import load_fault
from envs.sim.health import CAUSES
from tests.envs.test_resume import BUSY, flat, run, saved_and_loaded
from tests.envs.worlds import assert_same, make_env
from tests.forked import exit_code_in_fork

NAMES, NUM_ENVS, PER_ROBOT = ("h1", "g1", "t1"), 48, 16
SICK = PER_ROBOT + 13
"""Row of the environment that falls ill, in a later batch of the second robot."""
TASK = replace(BUSY, randomization=replace(BUSY.randomization, morphology_length_scale=(0.9, 1.1)))


def make(threads: int) -> HumanoidEnv:
    return make_env(NAMES, NUM_ENVS, TASK, threads=threads)


def assert_same_steps(one: list[Any], other: list[Any], what: str) -> None:
    for step, (first, second) in enumerate(zip(one, other, strict=True)):
        assert_same(first[0], second[0], f"{what}, step {step}")
        assert torch.equal(first[1], second[1]), f"rewards, {what}, step {step}"
        assert torch.equal(first[2], second[2]), f"dones, {what}, step {step}"
        assert_same(first[3]["final_observations"], second[3]["final_observations"], f"last ones, {what}, step {step}")


def test_the_number_of_threads_changes_no_bit() -> None:
    envs = {threads: make(threads) for threads in (1, 2, 3)}
    assert [len(env.pool.batches) for env in envs.values()] == [3, 9, 12], "batches depend on it"
    steps = {threads: run(env, range(60)) for threads, env in envs.items()}
    assert sum(int(out[2].sum()) for out in steps[1]) > NUM_ENVS / 4, "nobody was reset"
    states = [flat(env.state_dict()) for env in envs.values()]
    for i, threads in enumerate((2, 3), start=1):
        assert_same_steps(steps[1], steps[threads], f"{threads} threads")
        assert states[0] == states[i], f"saved states, {threads} threads"


@pytest.mark.parametrize("threads", [1, 2])
def test_numbers_beyond_single_precision_warn_in_no_thread(threads: int) -> None:
    env = make(threads)
    for _ in range(5):
        for batch in env.pool.batches:
            batch.qvel[0, 8] = 1e12
        env.step(torch.zeros(NUM_ENVS, env.num_actions))
    assert (env.pool.causes > 0).sum() == len(env.pool.batches)


def test_a_run_goes_on_with_any_number_of_threads() -> None:
    straight, stopped = make(1), make(3)
    expected = run(straight, range(70))
    run(stopped, range(20))
    for first, threads in ((20, 1), (45, 2)):
        resumed = make(threads)
        resumed.load_state_dict(saved_and_loaded(stopped.state_dict()))
        assert_same_steps(expected[first : first + 25], run(resumed, range(first, first + 25)), f"on {threads} threads")
        stopped = resumed
    assert flat(straight.state_dict()) == flat(stopped.state_dict())


def test_the_sick_are_numbered_among_their_robot_s_environments(tmp_path: Path) -> None:
    env = make(2)
    env.fault_folder = tmp_path
    run(env, range(3))
    ((part, (local,), _),) = env.pool.split(torch.tensor([SICK]))
    batch = env.pool.batches[part]
    assert local < SICK - PER_ROBOT, "it lies in the first batch"
    batch.qvel[local, 8] = np.nan
    seen = batch.qpos[local].copy()
    env.step(torch.zeros(NUM_ENVS, 32))
    assert env.pool.causes.nonzero().tolist() == [[SICK]]
    (path,) = tmp_path.iterdir()
    fault = load_fault(path)
    assert (fault.robot, fault.cause, fault.env) == ("g1", CAUSES[0], SICK - PER_ROBOT)
    assert np.array_equal(fault.qpos[-2], np.float32(seen))


def step_in_child(env: HumanoidEnv, expected: list[Any]) -> None:
    found = run(env, range(3))
    os._exit(0 if all(torch.equal(first[1], second[1]) for first, second in zip(found, expected, strict=True)) else 3)


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork")
def test_a_forked_process_steps_with_threads_of_its_own() -> None:
    env, parent = make(2), make(2)
    state = env.state_dict()
    run(env, range(3))  # which makes the threads
    env.load_state_dict(state)
    code = exit_code_in_fork(step_in_child, env, run(parent, range(3)))
    assert code == 0, "the child simulates something else than its parent"


def test_there_is_one_thread_per_core_unless_said_otherwise() -> None:
    assert make(0).pool.threads.count == usable_cores()
    assert make(3).pool.threads.count == 3
