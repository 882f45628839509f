"""The losses added to PPO's, as pure functions.

N rows, S slots; ``mask`` (N, S) is 1 in live slots. Every reduction is a mean over rows and over live slots or
dimensions (the paper prints expectations without stating the reduction; see docs/decisions.md).
"""

from __future__ import annotations

import torch
from torch import Tensor

BASE_VELOCITY_DIM = 3
"""Leading entries of the estimate; the embodiment observation o_ea follows."""


def masked_mse(difference: Tensor, mask: Tensor) -> Tensor:
    """Mean square of ``difference`` (N, S) over live slots, scalar."""
    return (difference.square() * mask).sum() / mask.sum()


def action_loss(mean: Tensor, teacher_mean: Tensor, mask: Tensor) -> Tensor:
    """L_a, paper Eq. 7: (pi_g(o_t) - pi_s(o_t))^2 on action means (N, S)."""
    return masked_mse(mean - teacher_mean, mask)


def in_noise_units(action: Tensor, teacher_std: Tensor, mask: Tensor) -> Tensor:
    """Actions or their differences (N, S) as multiples of the specialist's noise, the unit of PPO's own loss."""
    return action / (teacher_std + 1 - mask)


def embedding_loss(embedding: Tensor, teacher_embedding: Tensor) -> Tensor:
    """L_e, paper Eq. 8: (e_g(s_t) - e_s(s_t))^2 on embeddings (N, E)."""
    return (embedding - teacher_embedding).square().mean()


def estimation_loss(estimate: Tensor, target: Tensor) -> Tensor:
    """MSE of the base velocity plus MSE of o_ea, each a mean over its own dimensions (HugWBC 6).

    Shapes (N, 33), or (N, 3) without embodiment observation.
    """
    error = (estimate - target).square()
    loss = error[:, :BASE_VELOCITY_DIM].mean()
    if error.shape[1] > BASE_VELOCITY_DIM:
        loss = loss + error[:, BASE_VELOCITY_DIM:].mean()
    return loss


def mirror_loss(mean: Tensor, mean_of_mirrored: Tensor, perm: Tensor, sign: Tensor, mask: Tensor) -> Tensor:
    """(stopgrad(mu(o)) - M_a mu(M_o o))^2 (HugWBC 6).

    Args:
        mean: mu(o), shape (N, S); receives no gradient.
        mean_of_mirrored: mu(M_o o), shape (N, S).
        perm: slot whose value the mirrored robot has in each slot, shape (S,).
        sign: its sign, shape (S,).
        mask: live slots of o's robot, shape (N, S).
    """
    return masked_mse(mean.detach() - mean_of_mirrored[:, perm] * sign, mask)


def kickstarting_loss(teacher_mean: Tensor, teacher_std: Tensor, mean: Tensor, std: Tensor, mask: Tensor) -> Tensor:
    """KL(pi_s || pi_g) of Gaussians over live slots [nat], mean over rows (Kickstarting baseline of the paper)."""
    absent = 1 - mask
    teacher_std, std = teacher_std + absent, std + absent
    variance_ratio = (teacher_std / std).square()
    distance = ((teacher_mean - mean) / std).square()
    return 0.5 * (variance_ratio + distance - 1 - torch.log(variance_ratio)).sum(dim=-1).mean()
