"""What learning computes of many rows: shared out among threads, by compiled kernels where asked for.

A thread computes its rows from beginning to end without waiting for another. Where threads waited for each other after
every network, two were hardly quicker than one.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from eagle_rl import kernels
from eagle_rl.errors import CompileError, EagleWarning
from eagle_rl.threads import num_threads, share_out

MIN_WORK = 2**25
"""Multiplications of a share, rows by parameters. To share out and gather takes .6 ms, in which a core does so many."""

Outcome = Sequence[Tensor]


@dataclass(frozen=True)
class Share:
    """Rows that one thread computes: tensors by name, (n, ...), and scalars that all shares have in common."""

    tensors: Mapping[str, Tensor]
    index: int
    """Which of the shares."""
    count: int
    """Shares of the whole."""
    size: int
    """Rows of the whole, N."""

    def __getitem__(self, name: str) -> Tensor:
        return self.tensors[name]

    @cached_property
    def kind(self) -> Hashable:
        """What it has in common with its like: all that is computed of it depends on its tensors and on this alone."""
        return self.size, tuple(x.shape for x in self.tensors.values())

    def leading(self, fraction: float) -> tuple[int, int]:
        """How many of its first rows lead the whole, and how many do, where it has every ``count``-th of the rows."""
        rows = max(1, round(fraction * self.size))
        return len(range(self.index, rows, self.count)), rows


class Computation(nn.Module):
    """What is computed of a share with the parameters of some models; the models are submodules.

    Subclasses write :meth:`forward`, which must leave no trace in the models: other threads use them too.
    """

    needs_graph = False
    """Whether :meth:`finish` follows the graph of the forward pass back."""

    def finish(self, result: Any, parameters: Sequence[Tensor]) -> Outcome:
        """Turn what ``forward`` returned into tensors, given the parameters it was computed with."""
        return tuple(result)

    def compute(self, share: Share) -> Outcome:
        """What comes of a share."""
        with torch.set_grad_enabled(self.needs_graph):
            return self.finish(self(share), list(self.parameters()))

    def compute_at(self, parameters: Sequence[Tensor], share: Share) -> Outcome:
        """The same at other values of the parameters; other threads must not compute meanwhile."""
        names = (name for name, _ in self.named_parameters())
        with torch.set_grad_enabled(self.needs_graph):
            return self.finish(functional_call(self, dict(zip(names, parameters, strict=True)), (share,)), parameters)


class Shared:
    """Computes shares side by side."""

    def __init__(self, computation: Computation) -> None:
        """Compute as it says, eagerly unless told otherwise."""
        self._computation = computation
        self._parameters = list(computation.parameters())
        self._kernels: dict[Hashable, Callable[[Share], Outcome]] = {}
        self._compiled = self._gave_up = False

    def num_shares(self, rows: int) -> int:
        """How many shares of so many rows are worth a thread's while; one on a GPU."""
        if self._parameters[0].device.type != "cpu":
            return 1
        worth = rows * sum(p.numel() for p in self._parameters) // MIN_WORK
        return max(1, min(num_threads(), worth))

    def compile(self) -> None:
        """Use a kernel for each kind of share from now on, made when the first of its kind comes."""
        self._compiled = not self._gave_up

    def __call__(self, shares: Sequence[Share]) -> list[Outcome]:
        """What comes of each share."""
        if self._compiled:
            self._make_kernels(shares)
        return share_out(self._compute, shares)

    def _compute(self, share: Share) -> Outcome:
        return self._kernels[share.kind](share) if self._compiled else self._computation.compute(share)

    def _make_kernels(self, shares: Sequence[Share]) -> None:
        """A kernel for every kind of share among these; where one cannot be made, that is a warning."""
        try:
            for share in shares:
                if share.kind not in self._kernels:
                    self._kernels[share.kind] = _make_kernel(self._computation, self._parameters, share)
        except CompileError as error:
            self._compiled, self._gave_up = False, True
            warnings.warn(f"{error} Training goes on without, a little slower.", EagleWarning, stacklevel=2)


def _make_kernel(computation: Computation, parameters: Sequence[Tensor], example: Share) -> Callable[[Share], Outcome]:
    """The kernel of a computation for shares like this one."""
    names, wanted = list(example.tensors), [parameter.requires_grad for parameter in parameters]

    def compute(*inputs: Tensor) -> list[Tensor]:
        at = [x.requires_grad_(want) for x, want in zip(inputs[: len(wanted)], wanted, strict=True)]
        share = replace(example, tensors=dict(zip(names, inputs[len(wanted) :], strict=True)))
        return list(computation.compute_at(at, share))

    inputs = [x.detach().clone() for x in (*parameters, *example.tensors.values())]
    kernel = kernels.compile_graph(kernels.record(compute, inputs), inputs)

    def replay(share: Share) -> Outcome:
        with torch.no_grad():
            return kernel(*(p.detach() for p in parameters), *(share[name] for name in names))

    return replay
