"""Data-parallel processes run one experiment together."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
import torch
import torch.multiprocessing

from eagle_rl.errors import ConfigError
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.stages import run_experiment
from eagle_rl.runners.team import Team
from tests.runners.toy_run import ENVS, STEPS, make_toy_env, parameters, toy_experiment

CFG = toy_experiment(iterations=2, judge_envs=2)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def member(rank: int, folder: Path, port: int) -> None:
    """What torchrun starts."""
    torch.set_num_threads(1)
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2"}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    result = run_experiment(CFG, folder / "run", make_toy_env)
    torch.save(parameters(result), folder / f"rank{rank}.pt")
    torch.distributed.destroy_process_group()


def test_two_processes_finish_every_stage_with_one_set_of_parameters(tmp_path):
    torch.multiprocessing.start_processes(member, (tmp_path, free_port()), nprocs=2, start_method="fork")
    zero, one = (torch.load(tmp_path / f"rank{rank}.pt") for rank in (0, 1))
    assert all(torch.equal(zero[key], one[key]) for key in zero)
    result = run_experiment(CFG, tmp_path / "run", make_toy_env, resume=True)
    budgets = {stage.name: 2 * ENVS * STEPS for stage in plan_stages(CFG)}
    assert {name: record.env_steps for name, record in result.records.items()} == budgets


def test_a_budget_takes_half_the_iterations_with_two_processes():
    assert [stage.iterations for stage in plan_stages(CFG, 2)] == [1] * 5


def test_jobs_and_data_parallel_processes_exclude_each_other(tmp_path):
    team = Team()
    team.size = 2
    with pytest.raises(ConfigError, match="--jobs 2"):
        run_experiment(CFG, tmp_path, make_toy_env, jobs=2, team=team)
