"""The rollout, with where its returns are cut and minibatches that are shared out among threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.algorithms.sharing import Share
from eagle_rl.threads import share_out

Cut = tuple[int, Tensor, TensorDict]
"""A step, the environments whose returns end with it, shape (n,), and their final observations."""


class Rollout(RolloutStorage):
    """Gathers each minibatch once an update, by ``index_select``, which takes a fifth of the time of indexing."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """As rsl_rl's, with nothing cut."""
        super().__init__(*args, **kwargs)
        self.cuts: list[Cut] = []
        """Where the value beyond is still to be added to the rewards."""

    def clear(self) -> None:
        """Begin anew."""
        super().clear()
        self.cuts = []

    def minibatches(
        self,
        num_mini_batches: int,
        num_epochs: int,
        num_shares: int = 1,
        prepare: Callable[[Share], Share] = lambda share: share,
        **common: Tensor,
    ) -> Iterator[list[Share]]:
        """Minibatches of all transitions in one random order, the same in every epoch: a second copy of the rollout.

        Args:
            num_mini_batches: of an epoch.
            num_epochs: how often each minibatch comes.
            num_shares: parts of each minibatch.
            prepare: what is made of each share, once for all epochs and without what is common to all.
            common: scalars that every share gets by name.

        Yields:
            Shares of a minibatch: each has every ``num_shares``-th row, so that leading rows are shared out alike.
            Their tensors are the observation groups, (n, ...); ``actions``, ``old_mean``, ``old_std``, (n, 32);
            ``values``, ``returns``, ``advantages``, ``old_log_prob``, (n,); and ``live``, the mean number of live slots
            of a row of the minibatch, a scalar.
        """
        size = self.num_envs * self.num_transitions_per_env // num_mini_batches
        order = torch.randperm(num_mini_batches * size, device=self.device)
        batches = [self._shares(ids, num_shares, prepare, common) for ids in order.split(size)]
        for _ in range(num_epochs):
            yield from batches

    def _shares(
        self, ids: Tensor, count: int, prepare: Callable[[Share], Share], common: dict[str, Tensor]
    ) -> list[Share]:
        """The transitions of these rows, shape (N,), shared out."""

        def part(index: int) -> Share:
            return prepare(Share(self._gather(ids[index::count]), index, count, len(ids)))

        parts = share_out(part, range(count))
        common = common | {"live": torch.stack([part["slot_mask"].sum() for part in parts]).sum() / len(ids)}
        return [replace(part, tensors={**part.tensors, **common}) for part in parts]

    def _gather(self, ids: Tensor) -> dict[str, Tensor]:
        """The transitions of these rows, shape (n,)."""
        mean, std = self.distribution_params
        numbers = {"values": self.values, "returns": self.returns, "advantages": self.advantages}
        numbers |= {"old_log_prob": self.actions_log_prob}
        rows = {"actions": self.actions, "old_mean": mean, "old_std": std} | dict(self.observations.items())
        tensors = rows | {name: x.squeeze(-1) for name, x in numbers.items()}
        return {name: x.flatten(0, 1).index_select(0, ids) for name, x in tensors.items()}
