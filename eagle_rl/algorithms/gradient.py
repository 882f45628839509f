"""The gradient of the whole loss on a minibatch; it is a sum over rows, so that shares of a minibatch add up to it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from rsl_rl.models import MLPModel
from torch import Tensor

from eagle_rl.algorithms.sharing import Computation, Outcome, Share, Shared
from eagle_rl.algorithms.terms import Log, Mirror, Policy, Term
from eagle_rl.models import EagleActor
from eagle_rl.models.distribution import kl_divergence

KL = "Loss/kl"
"""Tag of KL(old || new) [nat], which the learning rate is adapted to."""


class Gradient:
    """Puts the gradient of the sum of all terms into the parameters of actor and critic.

    It is one vector, of which each parameter's is a view, from one minibatch to the next: to add up, to measure and to
    hand over dozens of tensors takes longer.
    """

    def __init__(self, actor: EagleActor, critic: MLPModel, mixed_precision: bool) -> None:
        """Start without terms; with ``mixed_precision`` hidden layers multiply in bfloat16."""
        self._loss = _Loss(actor, critic, mixed_precision)
        self._shared = Shared(self._loss)
        self._vector = torch.empty(0)
        self._views: list[tuple[Tensor, Tensor]] = []
        self._parts: Sequence[Tensor] = ()
        self.terms: list[Term] = self._loss.terms
        """What is summed; complete before the first minibatch."""
        self.num_shares = self._shared.num_shares
        self.compile = self._shared.compile

    @property
    def tags(self) -> list[str]:
        """Of the losses that the last call returned."""
        return self._loss.tags

    def prepare(self, share: Share) -> Share:
        """A share as the terms want it, which is the same in every epoch."""
        for term in self.terms:
            if isinstance(term, Mirror):
                share = term.reflect(share)
        return share

    def __call__(self, shares: Sequence[Share]) -> Tensor:
        """Put the gradient of the loss on a minibatch, whose shares are prepared, into the parameters it depends on.

        Returns:
            Unweighted losses, a row for each of ``tags``: sum and weight, shape (T, 2).
        """
        vectors, sums = zip(*self._shared(shares), strict=True)
        first, *others = vectors
        if len(self._vector) != len(first) or any(parameter.grad is not view for parameter, view in self._views):
            self._lay_out(first)
        if others:
            torch.add(first, others[0], out=self._vector)
        else:
            self._vector.copy_(first)
        for vector in others[1:]:
            self._vector += vector
        return torch.stack(sums).sum(dim=0)

    def _lay_out(self, vector: Tensor) -> None:
        """Give every parameter on which the loss depends its part of such a vector for a gradient."""
        learned = self._loss.learned
        self._vector = torch.empty_like(vector)
        parts = self._vector.split([parameter.numel() for parameter in learned])
        self._views = [(p, part.view_as(p)) for p, part in zip(learned, parts, strict=True)]
        for parameter, view in self._views:
            parameter.grad = view
        actors = {id(parameter) for parameter in self._loss.actor.parameters()}
        self._parts = self._vector.tensor_split([sum(p.numel() for p in learned if id(p) in actors)])

    def clip(self, max_norm: float) -> list[float]:
        """Shorten the actor's and the critic's gradient to this length; return the lengths they had."""
        norms: list[float] = torch.stack([part.norm() for part in self._parts]).tolist()
        for part, norm in zip(self._parts, norms, strict=True):
            if norm > max_norm:
                part.mul_(max_norm / norm)
        return norms


class _Loss(Computation):
    """A share's part of the loss, and its derivatives."""

    needs_graph = True

    def __init__(self, actor: EagleActor, critic: MLPModel, mixed_precision: bool) -> None:
        super().__init__()
        self.actor, self.critic = actor, critic
        self.terms: list[Term] = []
        self.tags: list[str] = []
        self.learned: list[Tensor] = []
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
        """Gradient of the parameters on which the loss depends, one after another, and what is logged."""
        loss, sums = result
        asked = [i for i, parameter in enumerate(parameters) if parameter.requires_grad]
        found = torch.autograd.grad(loss, [parameters[i] for i in asked], allow_unused=True)
        own = list(self.parameters())
        self.learned = [own[i] for i, gradient in zip(asked, found, strict=True) if gradient is not None]
        return torch.cat([gradient.flatten() for gradient in found if gradient is not None]), sums
