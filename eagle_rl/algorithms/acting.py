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
    """Samples actions; rows are shared out in float32, in bfloat16 even 512 of them take longer that way."""

    def __init__(self, actor: EagleActor, mixed_precision: bool) -> None:
        """With ``mixed_precision`` hidden layers multiply in bfloat16."""
        self._shared = Shared(_Acting(actor, mixed_precision))
        self._together = mixed_precision
        self.compile = self._shared.compile

    def __call__(self, obs: TensorDict) -> Decision:
        """Sample at some observations."""
        tensors = {group: obs[group].contiguous() for group in (*ACTOR_INPUTS, "slot_mask")}
        tensors["noise"] = torch.randn_like(tensors["slot_mask"])
        rows = len(tensors["noise"])
        count = 1 if self._together else self._shared.num_shares(rows)
        count = 1 if rows % count else count  # shares of two sizes would need two kernels
        parts = zip(*(x.chunk(count) for x in tensors.values()), strict=True)
        shares = [Share(dict(zip(tensors, part, strict=True)), index=0, count=count, size=rows) for part in parts]
        return Decision(*map(torch.cat, zip(*self._shared(shares), strict=True)))


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
