"""A Gaussian over the slots a robot has (paper, "Embodiment Alignment")."""

from __future__ import annotations

import math
from typing import Any

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from torch import Tensor
from torch.distributions import Normal

_LOG_SQRT_2_PI = 0.5 * math.log(2.0 * math.pi)


def log_prob(actions: Tensor, mean: Tensor, std: Tensor, mask: Tensor) -> Tensor:
    """Log-probability of actions (N, S) over live slots of a Gaussian with ``std`` (S,), shape (N,)."""
    distance = (actions - mean) / std
    return ((-0.5 * distance.square() - std.log() - _LOG_SQRT_2_PI) * mask).sum(dim=-1)


def entropy(std: Tensor, mask: Tensor) -> Tensor:
    """Entropy over live slots [nat] of a Gaussian with ``std`` (S,), shape (N,)."""
    return ((std.log() + 0.5 + _LOG_SQRT_2_PI) * mask).sum(dim=-1)


def kl_divergence(old_mean: Tensor, old_std: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """KL(old || new) over live slots [nat], shape (N,), of (N, S) each; absent slots have mean and std 0 in both."""
    absent = (old_std == 0).to(old_std.dtype)
    old_std, std = old_std + absent, std + absent
    ratio = (old_std / std).square()
    return 0.5 * (ratio + ((old_mean - mean) / std).square() - 1.0 - ratio.log()).sum(dim=-1)


class MaskedGaussian(GaussianDistribution):
    """Diagonal Gaussian in which absent slots are a point mass at zero.

    One standard deviation per slot is learned. Set ``mask`` (N, 32), 1 in live slots, before each forward pass. Absent
    slots sample exactly 0 and add nothing to log-probability, entropy and KL; their mean and std are reported as 0.
    """

    mask: Tensor

    def __init__(self, output_dim: int, init_std: float, std_range: tuple[float, float]) -> None:
        """Start every slot at ``init_std``, kept inside ``std_range``."""
        super().__init__(output_dim, init_std, std_range)

    def update(self, mlp_output: Tensor) -> None:
        """Take the means, shape (N, 32), of the next distribution."""
        self._distribution = Normal(mlp_output * self.mask, self.std_param.clamp(*self.std_range))

    def sample(self) -> Tensor:
        """Actions, shape (N, 32), exactly zero in absent slots."""
        return self._distribution.sample() * self.mask

    def deterministic_output(self, mlp_output: Tensor) -> Tensor:
        """Mean actions, shape (N, 32)."""
        return mlp_output * self.mask

    @property
    def std(self) -> Tensor:
        """Standard deviations, shape (N, 32)."""
        return self._distribution.stddev * self.mask

    @property
    def entropy(self) -> Tensor:
        """Entropy over live slots [nat], shape (N,)."""
        return entropy(self._distribution.stddev, self.mask)

    def log_prob(self, outputs: Tensor) -> Tensor:
        """Log-probability of actions over live slots, shape (N,)."""
        return log_prob(outputs, self._distribution.mean, self._distribution.stddev, self.mask)

    def kl_divergence(self, old_params: tuple[Tensor, ...], new_params: tuple[Tensor, ...]) -> Tensor:
        """KL(old || new) over live slots [nat], shape (N,); both are pairs (mean, std) of shape (N, 32)."""
        return kl_divergence(*old_params, *new_params)

    @torch.no_grad()
    def project_std(self) -> None:
        """Put the learned std back into its range; beyond it the clamp has no gradient and could never return."""
        self.std_param.clamp_(*self.std_range)

    def __getstate__(self) -> dict[str, Any]:
        """State without the last forward pass, whose graph cannot be copied."""
        state = self.__dict__ | {"_distribution": None}
        state.pop("mask", None)
        return state
