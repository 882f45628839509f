"""Every loss, row by row, as a pure function.

N rows, S slots; ``mask`` (N, S) is 1 in live slots. A loss is the mean of its rows over the minibatch. ``live`` is how
many live slots a row has on average over the minibatch, so that the mean of rows that are sums over slots divided by
``live`` is one over live slots (the paper prints expectations without stating the reduction; see docs/decisions.md).
"""

from __future__ import annotations

import torch
from torch import Tensor

BASE_VELOCITY_DIM = 3
"""Leading entries of the estimate; the embodiment observation o_ea follows."""


def surrogate_loss(log_ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """PPO's -min(r A, clip(r, 1 - clip, 1 + clip) A) with r = exp(``log_ratio``), shapes (N,)."""
    ratio = torch.exp(log_ratio)
    return -torch.min(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage)


def value_loss(value: Tensor, target: Tensor, old_value: Tensor, clip: float | None = None) -> Tensor:
    """(V - R)^2, shape (N,); with ``clip`` the larger of it and that of V no further than ``clip`` from the old V."""
    loss = (value - target).square()
    if clip is None:
        return loss
    return torch.max(loss, (old_value + (value - old_value).clamp(-clip, clip) - target).square())


def masked_square(difference: Tensor, mask: Tensor, live: Tensor) -> Tensor:
    """Rows (N,) whose mean is the mean square of ``difference`` (N, S) over live slots."""
    return (difference.square() * mask).sum(dim=1) / live


def action_loss(mean: Tensor, teacher_mean: Tensor, mask: Tensor, live: Tensor) -> Tensor:
    """L_a, paper Eq. 7: (pi_g(o_t) - pi_s(o_t))^2 on action means (N, S); shape (N,)."""
    return masked_square(mean - teacher_mean, mask, live)


def in_noise_units(action: Tensor, teacher_std: Tensor, mask: Tensor) -> Tensor:
    """Actions or their differences (N, S) as multiples of the specialist's noise, the unit of PPO's own loss."""
    return action / (teacher_std + 1 - mask)


def embedding_loss(embedding: Tensor, teacher_embedding: Tensor) -> Tensor:
    """L_e, paper Eq. 8: (e_g(s_t) - e_s(s_t))^2 on embeddings (N, E), a mean over E; shape (N,)."""
    return (embedding - teacher_embedding).square().mean(dim=1)


def estimation_loss(estimate: Tensor, target: Tensor) -> Tensor:
    """MSE of the base velocity plus MSE of o_ea, each a mean over its own dimensions (HugWBC 6), shape (N,).

    Arguments are (N, 33), or (N, 3) without embodiment observation.
    """
    error = (estimate - target).square()
    loss = error[:, :BASE_VELOCITY_DIM].mean(dim=1)
    if error.shape[1] > BASE_VELOCITY_DIM:
        loss = loss + error[:, BASE_VELOCITY_DIM:].mean(dim=1)
    return loss


def mirror_loss(
    mean: Tensor, mean_of_mirrored: Tensor, perm: Tensor, sign: Tensor, mask: Tensor, live: Tensor
) -> Tensor:
    """(stopgrad(mu(o)) - M_a mu(M_o o))^2 (HugWBC 6), shape (N,).

    Args:
        mean: mu(o), shape (N, S); receives no gradient.
        mean_of_mirrored: mu(M_o o), shape (N, S).
        perm: slot whose value the mirrored robot has in each slot, shape (S,).
        sign: its sign, shape (S,).
        mask: live slots of o's robot, shape (N, S).
        live: see the module.
    """
    return masked_square(mean.detach() - mean_of_mirrored[:, perm] * sign, mask, live)
