"""A Gaussian over the slots a robot has (paper, "Embodiment Alignment")."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from torch import Tensor
from torch.distributions import Normal, kl_divergence


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
        return (self._distribution.entropy() * self.mask).sum(dim=-1)

    def log_prob(self, outputs: Tensor) -> Tensor:
        """Log-probability of actions over live slots, shape (N,)."""
        return (self._distribution.log_prob(outputs) * self.mask).sum(dim=-1)

    def kl_divergence(self, old_params: tuple[Tensor, ...], new_params: tuple[Tensor, ...]) -> Tensor:
        """KL(old || new) over live slots [nat], shape (N,).

        Both are pairs (mean, std) of shape (N, 32) of the same robots. A slot whose old std is 0 is absent; giving it
        std 1 on both sides makes its term exactly 0.
        """
        absent = (old_params[1] == 0).to(old_params[1].dtype)
        old, new = (Normal(mean, std + absent) for mean, std in (old_params, new_params))
        return kl_divergence(old, new).sum(dim=-1)

    @torch.no_grad()
    def project_std(self) -> None:
        """Put the learned std back into its range; beyond it the clamp has no gradient and could never return."""
        self.std_param.clamp_(*self.std_range)

    def __getstate__(self) -> dict[str, Any]:
        """State without the last forward pass, whose graph cannot be copied."""
        state = self.__dict__ | {"_distribution": None}
        state.pop("mask", None)
        return state
