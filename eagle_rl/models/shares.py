"""Rows of a network's input shared out among threads, which is how learning on a CPU uses more than one core.

torch's own threads are OpenMP's. They wait for each other by spinning, and where other work has the cores as well an
update takes 3.5 to 20 times as long. The threads here wait asleep: on a busy machine they lose next to nothing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import reduce
from typing import Any, TypeVar

import torch
from rsl_rl.modules import MLP
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

T = TypeVar("T")

MIN_WORK = 2**25
"""Multiplications of a share, rows by parameters. To share out and gather takes .6 ms, in which a core does so many."""


class _Threads:
    """Threads of this process, the caller's among them."""

    def __init__(self) -> None:
        self.count = 1
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def resize(self, count: int) -> None:
        """Be so many from now on."""
        if self._pool is not None and self._process == os.getpid():
            self._pool.shutdown()
        self.count, self._pool = count, None

    def map(self, do: Callable[[Any], T], tasks: Iterable[Any]) -> list[T]:
        """What ``do`` returns for each task, in their order; what it raises for one is raised when all are over.

        The caller begins with the last and takes what nobody else has begun, so that it does not wait for a thread to
        which a busy machine has yet to give a core.
        """
        waiting = list(tasks)
        futures = [self._helpers().submit(do, task) for task in waiting]
        own: dict[int, T] = {}
        try:
            for i in reversed(range(len(waiting))):
                if futures[i].cancel():
                    own[i] = do(waiting[i])
        finally:
            wait([future for future in futures if not future.cancel()])
        return [own[i] if i in own else future.result() for i, future in enumerate(futures)]

    def _helpers(self) -> ThreadPoolExecutor:
        """The others, made when first needed: a forked process has none of its parent's."""
        if self._pool is None or self._process != os.getpid():
            # Asked for its number of threads, torch sets it in the thread that asks; some of its libraries do not ask.
            self._pool = ThreadPoolExecutor(self.count - 1, "share", initializer=torch.get_num_threads)
            self._process = os.getpid()
        return self._pool


_threads = _Threads()


def use_threads(count: int) -> None:
    """Share rows out among so many threads of this process from now on; 1 computes them as torch does."""
    _threads.resize(count)


class SharedMLP(MLP):
    """A network that computes blocks of its input's rows in several threads, forward and backward.

    Results depend on the number of threads, as sums depend on their order, and never on which of them was first.
    There are no second derivatives.
    """

    def __init__(self, network: MLP) -> None:
        """Take over the layers of ``network``."""
        nn.Sequential.__init__(self, *network)  # MLP's own makes new ones
        self._least_rows = _least_rows(network)

    def forward(self, x: Tensor) -> Tensor:
        """Outputs (N, ...) of rows (N, C)."""
        blocks = _blocks(x, self._least_rows)
        if len(blocks) == 1:
            return super().forward(x)
        parameters = tuple(self.parameters())
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (x, *parameters)):
            return _Shares.apply(super().forward, len(blocks), x, *parameters)
        return torch.cat(_threads.map(_in_any_thread(super().forward), blocks))


def share_rows(model: nn.Module) -> None:
    """Let a model's networks share their rows out among the threads of :func:`use_threads`."""
    for name, network in list(model.named_children()):
        if isinstance(network, MLP):
            setattr(model, name, SharedMLP(network))


class _Shares(torch.autograd.Function):
    """A network over blocks of rows, each with a graph of its own that one thread makes and follows back."""

    @staticmethod
    def forward(ctx: Any, network: Callable[[Tensor], Tensor], count: int, x: Tensor, *parameters: Tensor) -> Tensor:
        """Outputs (N, ...) of ``network``, which has ``parameters``, for ``count`` blocks of rows ``x`` (N, C)."""
        blocks = [block.detach().requires_grad_(x.requires_grad) for block in x.tensor_split(count)]
        outputs = _threads.map(_in_any_thread(network, with_graph=True), blocks)
        ctx.parameters, ctx.graphs = parameters, list(zip(blocks, outputs, strict=True))
        return torch.cat([output.detach() for output in outputs])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of ``x``, row by row, and of the parameters, summed in the order of the blocks."""
        of_x, *of_parameters = ctx.needs_input_grad[2:]
        learned = [parameter for parameter, wanted in zip(ctx.parameters, of_parameters, strict=True) if wanted]

        def follow(task: tuple[tuple[Tensor, Tensor], Tensor]) -> tuple[Tensor, ...]:
            (block, output), block_grad = task
            return torch.autograd.grad(output, [*learned, block] if of_x else learned, block_grad)

        grads = grad.split([len(block) for block, _ in ctx.graphs])
        found = _threads.map(_in_any_thread(follow), zip(ctx.graphs, grads, strict=True))
        x_grad = torch.cat([grads[-1] for grads in found]) if of_x else None
        sums = iter([reduce(torch.add, same) for same in zip(*(grads[: len(learned)] for grads in found), strict=True)])
        return None, None, x_grad, *(next(sums) if wanted else None for wanted in of_parameters)


def _least_rows(network: nn.Module) -> int:
    """Rows of a share that are worth a thread's while."""
    return max(1, MIN_WORK // sum(parameter.numel() for parameter in network.parameters()))


def _blocks(x: Tensor, least_rows: int) -> tuple[Tensor, ...]:
    """Contiguous rows of ``x`` (N, C) for each thread that gets enough of them; all of ``x`` where there is no other.

    A network that is exported is whole: its graph is to hold for any number of rows.
    """
    if _threads.count == 1 or x.ndim != 2 or x.device.type != "cpu" or torch.compiler.is_compiling():
        return (x,)
    return x.tensor_split(max(1, min(_threads.count, len(x) // least_rows)))


def _in_any_thread(do: Callable[[Any], T], with_graph: bool = False) -> Callable[[Any], T]:
    """``do`` under this thread's modes, which other threads would not have, and with a graph only if asked for.

    Casts of parameters are not kept: they belong to the graph of the thread that made them.
    """
    inference = torch.is_inference_mode_enabled()
    mixed, dtype = torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu")

    def done(task: Any) -> T:
        with (
            torch.inference_mode(inference),  # first, since it sets whether there are graphs
            torch.set_grad_enabled(with_graph),
            torch.autocast("cpu", dtype, mixed, cache_enabled=False),
        ):
            return do(task)

    return done
