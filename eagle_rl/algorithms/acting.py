"""Actions and how likely they were, computed just as the update will, so that its ratios start at one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.algorithms.sharing import Computation, Share, Shared
from eagle_rl.algorithms.terms import Policy
from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.models.distribution import log_prob


@dataclass(frozen=True)
class Decision:
    """What was done in each environment, and how likely that was."""

    actions: Tensor
    """Shape (N, 32), zero in absent slots."""
    mean: Tensor
    """Of their distribution, shape (N, 32), zero in absent slots."""
    std: Tensor
    """Of their distribution, shape (N, 32), zero in absent slots."""
    log_prob: Tensor
    """Shape (N,)."""


class Acting:
    """Samples actions; all rows at once, which even with 512 of them is quicker than to share them out."""

    def __init__(self, actor: EagleActor, mixed_precision: bool) -> None:
        """With ``mixed_precision`` hidden layers multiply in bfloat16."""
        self._shared = Shared(_Acting(actor, mixed_precision))
        self.compile = self._shared.compile

    def __call__(self, obs: TensorDict) -> Decision:
        """Sample at some observations."""
        tensors = {group: obs[group].contiguous() for group in (*ACTOR_INPUTS, "slot_mask")}
        tensors["noise"] = torch.randn_like(tensors["slot_mask"])
        (found,) = self._shared([Share(tensors, index=0, count=1, size=len(tensors["noise"]))])
        return Decision(*found)


class _Acting(Computation):
    """What becomes of a share's rows."""

    def __init__(self, actor: EagleActor, mixed_precision: bool) -> None:
        super().__init__()
        self.actor = actor
        self._mixed_precision = mixed_precision

    def forward(self, share: Share) -> tuple[Tensor, ...]:
        """The fields of a :class:`Decision`."""
        mask = share["slot_mask"]
        with torch.autocast(mask.device.type, torch.bfloat16, self._mixed_precision, cache_enabled=False):
            policy = Policy.of(self.actor, share)
        actions = (policy.mean + policy.std * share["noise"]) * mask
        return actions, policy.mean, policy.std * mask, log_prob(actions, policy.mean, policy.std, mask)
