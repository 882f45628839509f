"""Two processes with half of the environments each learn what one process with all of them learns."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import torch
import torch.multiprocessing
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from eagle_rl.runners.on_policy import EagleRunner
from tests.learner.helpers import collect, make_runner, parameters
from tests.toy import ToyEnv

ENVS = 24
WHOLE_BATCH = {"num_learning_epochs": 3, "num_mini_batches": 1, "mirror_fraction": 1.0}
"""Minibatches would be drawn from each process's own rows."""
FIELDS = ("observations", "actions", "rewards", "dones", "values", "actions_log_prob")


def take_over(storage: RolloutStorage, union: RolloutStorage, rows: slice) -> None:
    """Copy what some environments did in the rollout of all."""
    for name in FIELDS:
        getattr(storage, name).copy_(getattr(union, name)[:, rows])
    storage.distribution_params = tuple(p[:, rows].clone() for p in union.distribution_params)
    storage.step = union.step


def learn(runner: EagleRunner, last: TensorDict) -> dict[str, torch.Tensor]:
    with torch.no_grad():
        runner.alg.compute_returns(last)
    runner.alg.update()
    return parameters(runner)


def half(rank: int, union: RolloutStorage, last: TensorDict, folder: Path, port: int) -> None:
    """What torchrun starts."""
    torch.set_num_threads(1)
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2"}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    rows = slice(rank * ENVS // 2, (rank + 1) * ENVS // 2)
    runner = make_runner(env=ToyEnv(ENVS // 2), **WHOLE_BATCH)
    take_over(runner.alg.storage, union, rows)
    torch.save(learn(runner, last[rows]), folder / f"rank{rank}.pt")
    torch.distributed.destroy_process_group()


def test_two_processes_equal_one_with_the_union_of_their_environments(tmp_path):
    runner = make_runner(env=ToyEnv(ENVS), **WHOLE_BATCH)
    before = parameters(runner)
    collect(runner)
    union, last = runner.alg.storage, runner._obs
    half_means = (union.returns - union.values).unflatten(1, (2, -1)).mean(dim=(0, 2)).flatten()
    assert abs(half_means[0] - half_means[1]) > 0.05, "both halves are alike, so the test shows nothing"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    torch.multiprocessing.start_processes(half, (union, last, tmp_path, port), nprocs=2, start_method="fork")
    together = learn(runner, last)
    for rank in (0, 1):
        apart = torch.load(tmp_path / f"rank{rank}.pt")
        for name, value in together.items():
            assert not torch.equal(value, before[name]) or "std_param" in name, f"{name} did not learn"
            torch.testing.assert_close(apart[name], value, rtol=1e-4, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}")
