"""The gradient of the whole loss on a minibatch; it is a sum over rows, so that shares of a minibatch add up to it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import torch
from rsl_rl.models import MLPModel
from torch import Tensor

from eagle_rl.algorithms.sharing import Computation, Outcome, Share, Shared
from eagle_rl.algorithms.terms import Log, Policy, Term
from eagle_rl.models import EagleActor
from eagle_rl.models.distribution import kl_divergence

KL = "Loss/kl"
"""Tag of KL(old || new) [nat], which the learning rate is adapted to."""


class Gradient:
    """Puts the gradient of the sum of all terms into the parameters of actor and critic."""

    def __init__(self, actor: EagleActor, critic: MLPModel, mixed_precision: bool) -> None:
        """Start without terms; with ``mixed_precision`` hidden layers multiply in bfloat16."""
        self._loss = _Loss(actor, critic, mixed_precision)
        self._shared = Shared(self._loss)
        self.terms: list[Term] = self._loss.terms
        """What is summed; complete before the first minibatch."""
        self.num_shares = self._shared.num_shares
        self.compile = self._shared.compile

    def __call__(self, shares: Sequence[Share]) -> dict[str, Tensor]:
        """Put the gradient of the loss on a minibatch into the parameters; None where it does not depend on one.

        Returns:
            Unweighted losses by tag: sum and weight, shape (2,).
        """
        *gradients, sums = (_sum(same) for same in zip(*self._shared(shares), strict=True))
        for parameter, gradient in zip(self._loss.parameters(), gradients, strict=True):
            parameter.grad = gradient
        assert sums is not None, "the KL is always told"
        return dict(zip(self._loss.tags, sums, strict=True))


class _Loss(Computation):
    """A share's part of the loss, and its derivatives."""

    needs_graph = True

    def __init__(self, actor: EagleActor, critic: MLPModel, mixed_precision: bool) -> None:
        super().__init__()
        self.actor, self.critic = actor, critic
        self.terms: list[Term] = []
        self.tags: list[str] = []
        self._mixed_precision = mixed_precision

    def forward(self, share: Share) -> tuple[Tensor, Tensor]:
        """Of the loss, a scalar, and of what is logged, shape (T, 2)."""
        log, device = Log(), share["actions"].device.type
        with torch.autocast(device, torch.bfloat16, self._mixed_precision, cache_enabled=False):
            policy = Policy.of(self.actor, share)
            loss = torch.stack([term(policy, share, log) for term in self.terms]).sum()
        std = policy.std * share["slot_mask"]
        log.add(KL, kl_divergence(share["old_mean"], share["old_std"], policy.mean.detach(), std.detach()))
        self.tags = list(log.entries)
        return loss, torch.stack(list(log.entries.values()))

    def finish(self, result: tuple[Tensor, Tensor], parameters: Sequence[Tensor]) -> Outcome:
        """Gradient of each parameter, or None, and what is logged."""
        loss, sums = result
        learned = [parameter for parameter in parameters if parameter.requires_grad]
        found = iter(torch.autograd.grad(loss, learned, allow_unused=True))
        return [*(next(found) if parameter.requires_grad else None for parameter in parameters), sums]


def _sum(parts: Sequence[Tensor | None]) -> Tensor | None:
    """Over all shares, in their order; None if the share has none, as then no other has."""
    return None if parts[0] is None else reduce(torch.add, (x for x in parts if x is not None))
