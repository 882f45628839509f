"""The critic's values of a rollout, worked out at its end: many rows at once, in all threads, cost half as much."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from rsl_rl.models import MLPModel
from torch import Tensor

from eagle_rl.algorithms.rollout import Rollout
from eagle_rl.algorithms.sharing import Computation, Share, Shared

ROWS = 2048
"""Valued at once."""


class Valuing:
    """Values a rollout when it is complete."""

    def __init__(self, critic: MLPModel, mixed_precision: bool) -> None:
        """With ``mixed_precision`` hidden layers multiply in bfloat16."""
        self._groups = critic.obs_groups
        self._computation = _Valuing(critic, mixed_precision)
        self._shared = Shared(self._computation)
        self.compile = self._shared.compile

    def value(self, rollout: Rollout, gamma: float) -> None:
        """Fill in the values of all observations; where returns are cut, rewards get the discounted value beyond."""
        groups = self._groups
        columns = [rollout.observations[group].flatten(0, 1).split(ROWS) for group in groups]
        chunks = [_whole(dict(zip(groups, chunk, strict=True))) for chunk in zip(*columns, strict=True)]
        values = torch.cat([value for (value,) in self._shared(chunks)])
        rollout.values.copy_(values.view_as(rollout.values))
        cuts, rollout.cuts = rollout.cuts, []
        if cuts:
            finals = _whole({group: torch.cat([final[group] for *_, final in cuts]) for group in groups})
            (beyond,) = self._computation.compute(finals)  # of another number of rows each time
            for (step, ids, _), value in zip(cuts, beyond.split([len(ids) for _, ids, _ in cuts]), strict=True):
                rollout.rewards[step].index_add_(0, ids, gamma * value)


def _whole(tensors: Mapping[str, Tensor]) -> Share:
    """Rows that are nobody else's share."""
    return Share(tensors, index=0, count=1, size=len(next(iter(tensors.values()))))


class _Valuing(Computation):
    """Values of a share's rows, shape (n, 1)."""

    def __init__(self, critic: MLPModel, mixed_precision: bool) -> None:
        super().__init__()
        self.critic = critic
        self._mixed_precision = mixed_precision

    def forward(self, share: Share) -> tuple[Tensor]:
        """The values alone."""
        device = next(iter(share.tensors.values())).device.type
        with torch.autocast(device, torch.bfloat16, self._mixed_precision, cache_enabled=False):
            return (self.critic(share),)
