"""The critic's values of a rollout, worked out at its end: many rows at once, in all threads, cost half as much."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.threads import share_out

ROWS = 2048
"""Valued at once."""


class Valuing:
    """Remembers where returns are cut, and values a rollout when it is complete."""

    def __init__(self, critic: MLPModel, mixed_precision: bool) -> None:
        """With ``mixed_precision`` hidden layers multiply in bfloat16."""
        self._critic = critic
        self._mixed_precision = mixed_precision
        self._cuts: list[tuple[int, Tensor, TensorDict]] = []

    def cut(self, step: int, ids: Tensor, final: TensorDict) -> None:
        """Returns of environments ``ids``, shape (n,), end with a step of the rollout, in ``final`` observations."""
        self._cuts.append((step, ids, final))

    def value(self, storage: RolloutStorage, gamma: float) -> None:
        """Fill in the values of all observations; where returns are cut, rewards get the discounted value beyond."""
        cuts, self._cuts = self._cuts, []
        groups = self._critic.obs_groups
        columns = [storage.observations[group].flatten(0, 1).split(ROWS) for group in groups]
        rollout = [dict(zip(groups, chunk, strict=True)) for chunk in zip(*columns, strict=True)]
        values = torch.cat(share_out(self._values, rollout))
        storage.values.copy_(values.view_as(storage.values))
        if cuts:
            beyond = self._values({group: torch.cat([final[group] for *_, final in cuts]) for group in groups})
            for (step, ids, _), value in zip(cuts, beyond.split([len(ids) for _, ids, _ in cuts]), strict=True):
                storage.rewards[step].index_add_(0, ids, gamma * value)

    def _values(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Of some observations (n, ...), shape (n, 1)."""
        device = next(iter(obs.values())).device.type
        with torch.no_grad(), torch.autocast(device, torch.bfloat16, self._mixed_precision, cache_enabled=False):
            values: Tensor = self._critic(obs)
        return values
