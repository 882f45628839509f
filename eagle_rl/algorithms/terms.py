"""The terms of the loss, L = L_PPO + alpha L_a + beta L_e + ..., each evaluated on one forward pass of the policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from rsl_rl.models import MLPModel
from torch import Tensor

from eagle_rl.algorithms import losses
from eagle_rl.algorithms.sharing import Share
from eagle_rl.config.schema import AlgoCfg
from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.models.distribution import entropy, kl_divergence, log_prob
from eagle_rl.models.sides import MirrorMap, Sides


@dataclass(frozen=True)
class Policy:
    """What the policy says of a share's rows."""

    mean: Tensor
    """Of the actions, zero in absent slots, shape (n, 32)."""
    std: Tensor
    """Of all slots, shape (32,)."""
    embedding: Tensor
    """e(s_t), shape (n, E)."""
    estimate: Tensor
    """Shape (n, 3 or 33)."""
    mirrored: Tensor
    """Mean actions of the mirror images behind the rows, without a mask, shape (m, 32)."""

    @classmethod
    def of(cls, actor: EagleActor, share: Share) -> Policy:
        """One forward pass, which leaves no trace in the actor: other threads make theirs.

        What the actor reads of the share may go on with mirror images (:meth:`Mirror.reflect`): in one pass with the
        rows they take less time than in a pass of their own.
        """
        rows, (history, command, clock) = len(share["slot_mask"]), (share[group] for group in ACTOR_INPUTS)
        mean, embedding, estimate = actor.outputs(history, command, clock)
        std = actor.distribution.std_param.clamp(*actor.distribution.std_range)
        return cls(mean[:rows] * share["slot_mask"], std, embedding[:rows], estimate[:rows], mean[rows:])


class Log:
    """Sums and weights of what is told of an update, which add up over its shares."""

    def __init__(self) -> None:
        """Start empty."""
        self.entries: dict[str, Tensor] = {}
        """By tag: sum and weight, shape (2,)."""

    @torch.no_grad()
    def add(self, tag: str, rows: Tensor, where: Tensor | None = None) -> None:
        """Tell a number of each row, shape (n,), or of those ``where`` a condition (n,) holds."""
        weight = torch.ones_like(rows) if where is None else where.to(rows.dtype)
        self.entries[tag] = torch.stack(((rows.detach() * weight).sum(), weight.sum())).float()


class Term(Protocol):
    """A part of the loss."""

    def __call__(self, policy: Policy, share: Share, log: Log) -> Tensor:
        """The share's part of the weighted term, a scalar; its unweighted values go into ``log``."""


class Ppo:
    """L_PPO: clipped surrogate, value and entropy."""

    def __init__(self, critic: MLPModel, cfg: AlgoCfg) -> None:
        """Weigh and clip as ``cfg`` says."""
        self.critic = critic
        self.cfg = cfg

    def __call__(self, policy: Policy, share: Share, log: Log) -> Tensor:
        """Weighted loss."""
        cfg, mask = self.cfg, share["slot_mask"]
        log_ratio = log_prob(share["actions"], policy.mean, policy.std, mask) - share["old_log_prob"]
        surrogate = losses.surrogate_loss(log_ratio, share["advantages"], cfg.clip_param)
        clip = cfg.clip_param if cfg.use_clipped_value_loss else None
        value = losses.value_loss(self.critic(share).squeeze(1), share["returns"], share["values"], clip)
        spread = entropy(policy.std, mask)
        for name, rows in {"surrogate": surrogate, "value": value, "entropy": spread}.items():
            log.add(f"Loss/{name}", rows)
        return (surrogate + cfg.value_loss_coef * value - cfg.entropy_coef * spread).sum() / share.size


class Estimation:
    """The estimator's loss on base velocity and o_ea."""

    def __init__(self, coef: float) -> None:
        """Weigh the loss with ``coef``."""
        self.coef = coef

    def __call__(self, policy: Policy, share: Share, log: Log) -> Tensor:
        """Weighted loss."""
        rows = losses.estimation_loss(policy.estimate, share["estimate"])
        log.add("Loss/estimation", rows)
        return self.coef * rows.sum() / share.size


class Mirror:
    """The left/right mirror loss on the leading part of each minibatch, whose rows are in random order."""

    def __init__(self, coef: float, fraction: float, mirror: MirrorMap, device: torch.device | str) -> None:
        """Weigh the loss with ``coef`` and evaluate it on ``fraction`` of the rows."""
        self.coef = coef
        self.fraction = fraction
        self.sides = Sides({group: mirror[group] for group in ACTOR_INPUTS}).to(device)
        self.actions = tuple(x.to(device) for x in mirror["actions"])

    def reflect(self, share: Share) -> Share:
        """The share, with what a mirror shows of its leading rows behind all that the actor reads of it."""
        own, _ = share.leading(self.fraction)
        seen = {g: torch.cat((share[g], self.sides.mirrored(g, share[g][:own]))) for g in ACTOR_INPUTS}
        return replace(share, tensors={**share.tensors, **seen})

    def __call__(self, policy: Policy, share: Share, log: Log) -> Tensor:
        """Weighted loss."""
        own, everyone = share.leading(self.fraction)
        mask = share["slot_mask"][:own]
        perm, sign = self.actions
        mirrored = policy.mirrored * mask[:, perm]
        rows = losses.mirror_loss(policy.mean[:own], mirrored, perm, sign, mask, share["live"])
        log.add("Loss/mirror", rows)
        return self.coef * rows.sum() / everyone


class Distill:
    """alpha L_a + beta L_e towards the specialists' labels (paper, Eq. 9)."""

    def __init__(self, alpha: float, beta: float, robot_names: Sequence[str], in_noise_units: bool = False) -> None:
        """Weigh the action loss with ``alpha`` and the embedding loss with ``beta``.

        ``in_noise_units`` measures actions as multiples of the specialists' noise; the paper's are in units of action.
        """
        self.alpha, self.beta = alpha, beta
        self.robot_names = robot_names
        self.in_noise_units = in_noise_units

    def __call__(self, policy: Policy, share: Share, log: Log) -> Tensor:
        """Weighted loss; logs both terms per robot."""
        mask, mean, teacher = share["slot_mask"], policy.mean, share["teacher_action"]
        if self.in_noise_units:
            mean, teacher = (losses.in_noise_units(x, share["teacher_std"], mask) for x in (mean, teacher))
        action = losses.action_loss(mean, teacher, mask, share["live"])
        embedding = losses.embedding_loss(policy.embedding, share["teacher_embedding"])
        log.add("Distill/L_a", action)
        log.add("Distill/L_e", embedding)
        own_slots = action * share["live"] / mask.sum(dim=1)
        for robot, name in enumerate(self.robot_names):
            log.add(f"Distill/L_a/{name}", own_slots, share["robot"] == robot)
            log.add(f"Distill/L_e/{name}", embedding, share["robot"] == robot)
        return (self.alpha * action + self.beta * embedding).sum() / share.size


class Kickstart:
    """alpha exp(-lambda t) KL(pi_s || pi_g) towards the specialists' labels, t in updates (the paper's baseline)."""

    def __init__(self, alpha: float, decay: float) -> None:
        """Start at weight ``alpha`` and decay at the rate ``decay``, lambda."""
        self.alpha, self.decay = alpha, decay

    def __call__(self, policy: Policy, share: Share, log: Log) -> Tensor:
        """Weighted loss."""
        std = policy.std * share["slot_mask"]
        rows = kl_divergence(share["teacher_action"], share["teacher_std"], policy.mean, std)
        log.add("Distill/kickstart_kl", rows)
        return self.weight(share["num_updates"]) * rows.sum() / share.size

    def weight(self, num_updates: Tensor) -> Tensor:
        """Of the loss after so many updates, a scalar."""
        return self.alpha * torch.exp(-self.decay * num_updates)
