"""Kill -9 in every stage: the resumed run ends with the same bits as one that was never killed."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from eagle_rl.config.schema import ExperimentCfg, TaskCfg
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.stages import run_experiment
from tests.runners.toy_run import STEPS, JudgedToyEnv, parameters, toy_experiment

EAGLE = toy_experiment(iterations=3)
SEARCH = toy_experiment(iterations=3, search_env_steps=12 * 40)
CORRECT = toy_experiment(iterations=3, correction_env_steps=1)
COMPASS = toy_experiment(iterations=3, method="compass")
MID_ITERATION = 2 * STEPS + 1
"""Control steps of a stage before its process dies: in its last iteration, two checkpoints written."""
MID_GENERATION = 5 + 10 * 5 + 3
"""The same of a search: in its eleventh generation, one checkpoint written."""


class DeadlyEnv(JudgedToyEnv):
    """Kills the process after so many steps."""

    def __init__(self, num_envs: int, robots: tuple[str, ...], seed: int, steps_left: int | None) -> None:
        self.steps_left = steps_left
        super().__init__(num_envs, robots, seed)

    def step(self, actions: Tensor) -> Any:
        if self.steps_left is not None:
            self.steps_left -= 1
            if self.steps_left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
        return super().step(actions)


class MakeEnv:
    """Environments of which those with one seed are deadly."""

    def __init__(self, seed: int | None, steps: int) -> None:
        self.seed, self.steps = seed, steps

    def __call__(self, robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first: int = 0) -> DeadlyEnv:
        return DeadlyEnv(num_envs, tuple(robots), seed, self.steps if seed == self.seed else None)


def run_until_killed(cfg: ExperimentCfg, folder: Path, seed: int, steps: int) -> None:
    """Run or resume in a process of its own, which has to die."""
    fork = multiprocessing.get_context("fork")
    process = fork.Process(
        target=run_experiment, args=(cfg, folder, MakeEnv(seed, steps)), kwargs={"resume": folder.exists()}
    )
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL, "the process was to die in this stage"


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork")
@pytest.mark.filterwarnings("ignore:.*nothing better found")
@pytest.mark.parametrize("cfg", [EAGLE, COMPASS, SEARCH, CORRECT], ids=["eagle", "compass", "search", "correct"])
def test_killed_in_every_stage_a_run_ends_with_the_same_parameters(cfg, tmp_path):
    whole = run_experiment(cfg, tmp_path / "whole", MakeEnv(None, 0))
    folder = tmp_path / "killed"
    for stage in plan_stages(cfg):
        run_until_killed(cfg, folder, stage.seed, MID_GENERATION if stage.kind == "search" else MID_ITERATION)
    run_until_killed(cfg, folder, cfg.evaluation.seed, 3)
    killed = run_experiment(cfg, folder, MakeEnv(None, 0), resume=True)
    expected, found = parameters(whole), parameters(killed)
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[key], found[key]) for key in expected)
    assert {n: r.score for n, r in killed.records.items()} == {n: r.score for n, r in whole.records.items()}
