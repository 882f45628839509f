"""The rollout, with minibatches that are quick to gather on a CPU."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from rsl_rl.storage import RolloutStorage
from torch import Tensor


class Rollout(RolloutStorage):
    """Gathers rows with ``index_select``, which copies whole rows and so takes a fifth of the time of indexing."""

    def mini_batch_generator(self, num_mini_batches: int, num_epochs: int = 8) -> Iterator[RolloutStorage.Batch]:
        """Minibatches of all transitions in one random order, the same in every epoch."""
        size = self.num_envs * self.num_transitions_per_env // num_mini_batches
        order = torch.randperm(num_mini_batches * size, device=self.device)
        observations = self.observations.flatten(0, 1)

        def rows(x: Tensor, ids: Tensor) -> Tensor:
            return x.flatten(0, 1).index_select(0, ids)

        for _ in range(num_epochs):
            for ids in order.split(size):
                yield RolloutStorage.Batch(
                    observations=observations.apply(lambda x: x.index_select(0, ids), batch_size=[size]),  # noqa: B023
                    actions=rows(self.actions, ids),
                    values=rows(self.values, ids),
                    advantages=rows(self.advantages, ids),
                    returns=rows(self.returns, ids),
                    old_actions_log_prob=rows(self.actions_log_prob, ids),
                    old_distribution_params=tuple(rows(p, ids) for p in self.distribution_params),
                )
