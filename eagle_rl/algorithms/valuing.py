"""The critic's values of a rollout, worked out at its end: many rows at once, in all threads, cost half as much."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from rsl_rl.models import MLPModel
from torch import Tensor

from eagle_rl.algorithms.rollout import Rollout
from eagle_rl.threads import share_out

ROWS = 2048
"""Valued at once."""


class Valuing:
    """Values a rollout when it is complete."""

    def __init__(self, critic: MLPModel, mixed_precision: bool) -> None:
        """With ``mixed_precision`` hidden layers multiply in bfloat16."""
        self._critic = critic
        self._mixed_precision = mixed_precision

    def value(self, rollout: Rollout, gamma: float) -> None:
        """Fill in the values of all observations; where returns are cut, rewards get the discounted value beyond."""
        groups = self._critic.obs_groups
        columns = [rollout.observations[group].flatten(0, 1).split(ROWS) for group in groups]
        chunks = [dict(zip(groups, chunk, strict=True)) for chunk in zip(*columns, strict=True)]
        values = torch.cat(share_out(self._values, chunks))
        rollout.values.copy_(values.view_as(rollout.values))
        cuts, rollout.cuts = rollout.cuts, []
        if cuts:
            beyond = self._values({group: torch.cat([final[group] for *_, final in cuts]) for group in groups})
            for (step, ids, _), value in zip(cuts, beyond.split([len(ids) for _, ids, _ in cuts]), strict=True):
                rollout.rewards[step].index_add_(0, ids, gamma * value)

    def _values(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Of some observations (n, ...), shape (n, 1)."""
        device = next(iter(obs.values())).device.type
        with torch.no_grad(), torch.autocast(device, torch.bfloat16, self._mixed_precision, cache_enabled=False):
            values: Tensor = self._critic(obs)
        return values
