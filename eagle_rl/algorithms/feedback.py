"""Which way to change the gains with which a walking policy answers an error of its yaw rate.

PPO, which sees the yaw rate through sensor noise and under its own, had come to answer less than pays
(docs/experiments.md, 23). Gains are few, and so are found directly: change all of them a little one way
and the other way, on many robots at once, and regress what that does to the cost on the changes (Spall 1992,
simultaneous perturbation, with a regression in place of the mean).
"""

from __future__ import annotations

import torch
from torch import Tensor

from eagle_rl.algorithms.correction import Mirror
from eagle_rl.models.basis import half_a_cycle

RIDGE = 0.3
"""Of the regression, in variances of a change for each robot [-]."""


def mirrored_gains(gains: Tensor, mirror: Mirror) -> Tensor:
    """Gains (..., S, W) of the mirrored robot, whose yaw rate is turned round and whose phase is half a cycle on."""
    turned = -half_a_cycle(gains.shape[-1] // 2).to(gains)
    return gains[..., mirror.partner, :] * mirror.sign.unsqueeze(1) * turned


def symmetric(gains: Tensor, mirror: Mirror) -> Tensor:
    """What of gains (..., S, W) a mirror leaves alone."""
    return 0.5 * (gains + mirrored_gains(gains, mirror))


def descent(change: Tensor, difference: Tensor, mirror: Mirror) -> Tensor:
    """The direction in which the cost falls fastest.

    Args:
        change: of the gains of M robots, symmetric, shape (M, S, W).
        difference: half of what lies between the cost with the change and with its negative, shape (M,).
        mirror: of the robot.

    Returns:
        Symmetric gains of norm 1, or zeros where the cost does not answer at all; shape (S, W).
    """
    columns = change.flatten(1)
    ridge = RIDGE * columns.square().mean() * len(columns)
    normal = columns.T @ columns + ridge * torch.eye(columns.shape[1]).to(columns)
    slope = torch.linalg.solve(normal, columns.T @ difference).unflatten(0, change.shape[1:])
    downhill = -symmetric(slope, mirror)
    return downhill / downhill.norm().clamp(min=1e-12)
