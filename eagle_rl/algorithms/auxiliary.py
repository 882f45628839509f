"""The losses added to PPO's, as plug-ins that share PPO's forward and backward pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.algorithms import losses
from eagle_rl.algorithms.running_means import RunningMeans
from eagle_rl.algorithms.stopwatch import Stopwatch
from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.models.sides import MirrorMap, Sides


class AuxiliaryLoss(Protocol):
    """A loss evaluated right after the actor's forward pass on a minibatch."""

    def __call__(self, actor: EagleActor, obs: TensorDict, log: dict[str, Tensor]) -> Tensor:
        """Return the weighted loss and put its unweighted values into ``log`` under their tags."""


class Estimation:
    """The estimator's loss on base velocity and o_ea."""

    def __init__(self, coef: float) -> None:
        """Weigh the loss with ``coef``."""
        self.coef = coef

    def __call__(self, actor: EagleActor, obs: TensorDict, log: dict[str, Tensor]) -> Tensor:
        """Weighted loss."""
        loss = losses.estimation_loss(actor.estimate, obs["estimate"])
        log["Loss/estimation"] = loss
        return self.coef * loss


class Mirror:
    """The left/right mirror loss on the leading share of each minibatch, whose rows are in random order."""

    def __init__(self, coef: float, fraction: float, mirror: MirrorMap, device: torch.device | str) -> None:
        """Weigh the loss with ``coef`` and evaluate it on ``fraction`` of the rows."""
        self.coef = coef
        self.fraction = fraction
        self.sides = Sides({group: mirror[group] for group in ACTOR_INPUTS}).to(device)
        self.actions = tuple(x.to(device) for x in mirror["actions"])

    def __call__(self, actor: EagleActor, obs: TensorDict, log: dict[str, Tensor]) -> Tensor:
        """Weighted loss."""
        rows = max(1, round(self.fraction * len(obs)))
        mask = obs["slot_mask"][:rows]
        perm, sign = self.actions
        history, command, clock = (self.sides.mirrored(group, obs[group][:rows]) for group in ACTOR_INPUTS)
        mean_of_mirrored = actor.mean_actions(history, command, clock, mask[:, perm])
        loss = losses.mirror_loss(actor.output_mean[:rows], mean_of_mirrored, perm, sign, mask)
        log["Loss/mirror"] = loss
        return self.coef * loss


class Distill:
    """alpha L_a + beta L_e towards the specialists' labels (paper, Eq. 9)."""

    def __init__(self, alpha: float, beta: float, robot_names: Sequence[str], in_noise_units: bool = False) -> None:
        """Weigh the action loss with ``alpha`` and the embedding loss with ``beta``.

        ``in_noise_units`` measures actions as multiples of the specialists' noise; the paper's are in units of action.
        """
        self.alpha, self.beta = alpha, beta
        self.robot_names = robot_names
        self.in_noise_units = in_noise_units

    def __call__(self, actor: EagleActor, obs: TensorDict, log: dict[str, Tensor]) -> Tensor:
        """Weighted loss; logs both terms per robot."""
        mask, mean = obs["slot_mask"], actor.output_mean
        teacher = obs["teacher_action"]
        if self.in_noise_units:
            mean, teacher = (losses.in_noise_units(x, obs["teacher_std"], mask) for x in (mean, teacher))
        action = losses.action_loss(mean, teacher, mask)
        embedding = losses.embedding_loss(actor.embedding, obs["teacher_embedding"])
        with torch.no_grad():
            action_rows = (mean - teacher).square().sum(dim=1) / mask.sum(dim=1)
            embedding_rows = (actor.embedding - obs["teacher_embedding"]).square().mean(dim=1)
            log |= self._per_robot("Distill/L_a", action_rows, obs["robot"])
            log |= self._per_robot("Distill/L_e", embedding_rows, obs["robot"])
        log |= {"Distill/L_a": action, "Distill/L_e": embedding}
        return self.alpha * action + self.beta * embedding

    def _per_robot(self, tag: str, rows: Tensor, robot: Tensor) -> dict[str, Tensor]:
        """Mean of ``rows`` (N,) over each robot's rows; NaN for a robot without any."""
        sums = rows.new_zeros(len(self.robot_names)).index_add(0, robot, rows)
        means = sums / torch.bincount(robot, minlength=len(self.robot_names))
        return {f"{tag}/{name}": mean for name, mean in zip(self.robot_names, means, strict=True)}


class Kickstart:
    """alpha exp(-lambda t) KL(pi_s || pi_g) towards the specialists' labels."""

    def __init__(self, weight: Callable[[], float]) -> None:
        """Take the present weight, alpha exp(-lambda t), from ``weight``."""
        self.weight = weight

    def __call__(self, actor: EagleActor, obs: TensorDict, log: dict[str, Tensor]) -> Tensor:
        """Weighted loss."""
        loss = losses.kickstarting_loss(
            obs["teacher_action"], obs["teacher_std"], actor.output_mean, actor.output_std, obs["slot_mask"]
        )
        log["Distill/kickstart_kl"] = loss
        return self.weight() * loss


class AuxiliaryLosses:
    """The sum of the plug-ins, in the one place where ``PPO.update`` lets a loss be added before its backward pass.

    That place is meant for :class:`rsl_rl.extensions.Symmetry`, whose interface this class has. It is called right
    after the actor's forward pass, so it also measures the KL the learning rate is adapted to.
    """

    use_mirror_loss = True
    mirror_loss_coeff = 1.0

    def __init__(self, terms: Sequence[AuxiliaryLoss], stopwatch: Stopwatch) -> None:
        """Add up ``terms``, after which ``stopwatch`` is told that the forward pass is over."""
        self.terms = list(terms)
        self._stopwatch = stopwatch
        self._means = RunningMeans()
        self._kls: list[Tensor] = []

    def augment_batch(self, batch: RolloutStorage.Batch, original_batch_size: int) -> None:
        """Leave the batch as it is."""

    def compute_loss(self, actor: EagleActor, batch: RolloutStorage.Batch, original_batch_size: int) -> Tensor:
        """Sum of the weighted losses on a minibatch, scalar."""
        log: dict[str, Tensor] = {}
        total = batch.actions.new_zeros(())
        for term in self.terms:
            total = total + term(actor, batch.observations, log)
        with torch.no_grad():
            kl = actor.get_kl_divergence(batch.old_distribution_params, actor.output_distribution_params)
            self._kls.append(kl.mean())
        self._means.add(log)
        self._stopwatch.lap("forward")
        return total

    @property
    def last_kl(self) -> Tensor:
        """Mean KL(old || new) of the last minibatch [nat], scalar."""
        return self._kls[-1]

    def pop_means(self) -> dict[str, float]:
        """Means of the unweighted losses since the last call, by tag."""
        return self._means.pop()

    def pop_kl(self, num_mini_batches: int) -> Tensor:
        """Mean KL(old || new) of the last ``num_mini_batches`` minibatches [nat], scalar."""
        kls, self._kls = self._kls, []
        return torch.stack(kls[-num_mini_batches:]).mean()
