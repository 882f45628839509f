"""Data-parallel processes, as torchrun starts them: the first decides and writes, the others follow."""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import timedelta
from typing import Any, Literal, TypeVar

import torch
from typing_extensions import Self

from eagle_rl.errors import Interrupted

T = TypeVar("T")

PATIENCE = timedelta(days=7)
"""How long followers wait for a decision: the leader may be evaluating, or waiting for other workers' stages."""


def join_processes(device: str | torch.device) -> None:
    """Join the process group once: nccl where each process has a GPU of its own, else gloo, which can share one.

    Several processes on one GPU pay where the physics is the cost: while one learns or waits for the GPU, another's
    physics has the cores.
    """
    if torch.distributed.is_initialized():
        return
    on_gpu = torch.device(device).type == "cuda"
    own_gpu = on_gpu and torch.cuda.device_count() >= int(os.getenv("LOCAL_WORLD_SIZE", "1"))
    torch.distributed.init_process_group("nccl" if own_gpu else "gloo")


def over_processes(x: torch.Tensor, how: Literal["mean", "max"]) -> torch.Tensor:
    """Mean or maximum of a tensor over all processes; every process must ask."""
    pooled = x.clone()
    operation = torch.distributed.ReduceOp.MAX if how == "max" else torch.distributed.ReduceOp.SUM
    torch.distributed.all_reduce(pooled, operation)
    return pooled if how == "max" else pooled / torch.distributed.get_world_size()


class Team:
    """The processes that train one policy together."""

    def __init__(self, device: str | torch.device = "cpu") -> None:
        """Join the others, if there are any."""
        self.rank, self.size = int(os.getenv("RANK", "0")), int(os.getenv("WORLD_SIZE", "1"))
        self._group: Any = None
        if self.size > 1:
            join_processes(device)
            self._group = torch.distributed.new_group(backend="gloo", timeout=PATIENCE)

    def __enter__(self) -> Self:
        """The team itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Part together: a process that dies with its connections open aborts, or breaks off what others still say.

        After a fault there is nobody to wait for.
        """
        if self.size > 1 and (kind is None or issubclass(kind, Interrupted)):
            torch.distributed.barrier(self._group)
            torch.distributed.destroy_process_group()

    @property
    def leads(self) -> bool:
        """Whether this process decides and writes."""
        return self.rank == 0

    def agree(self, decide: Callable[[], T]) -> T:
        """What the leader decides, in every process."""
        decision: list[Any] = [decide() if self.leads else None]
        if self.size > 1:
            torch.distributed.broadcast_object_list(decision, src=0, group=self._group)
        return decision[0]
