"""An evolution strategy on the last layer of a policy.

PPO comes to rest where its reward is flat under its own noise, long before the tracking error does. A search needs no
noise on the actions: it changes the weights a little one way and the other way, lets both policies follow the same
commands from the same state, and walks towards the better half (antithetic sampling: Salimans et al. 2017, "Evolution
strategies as a scalable alternative to reinforcement learning"; normalised steps after Mania et al. 2018, "Simple
random search of static linear policies"). What was found is a sum on weights the policy has anyway.

Left and right are changed alike: half the parameters, and so twice the pairs for each of them.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from eagle_rl.config.schema import SearchCfg
from eagle_rl.models import EagleActor
from eagle_rl.models.sides import partners

MOMENTUM = 0.8
"""Share of the last direction that is kept in the next."""
FINAL_STEP = 0.2
"""Share of the first step that the last one is long; in between on a line."""
MIN_SPREAD = 0.01
"""Directions that move less than this share of the first are left out: a policy that acts differently may leave the
range in which they moved by far."""
MIN_PARITY = 0.5
"""Directions whose activations correlate less than this with those of the mirrored robot, or with their negative, are
left out: nobody can say what they would mean for the other leg."""
OUTLIER = 3.0
"""Differences beyond so many medians, mostly of falls, count as this many."""


class LastLayerSearch:
    """Parameters (S, D + 1): what D directions of the last hidden layer, and a constant, add to S actions.

    The directions span the principal ones of the activations a policy has when it walks. Each has unit variance, so
    that one step length fits them all, and is the same or the negative where left and right are exchanged; S are the
    joints the robot has.
    """

    def __init__(
        self,
        cfg: SearchCfg,
        *,
        slots: Tensor,
        mean: Tensor,
        directions: Tensor,
        partner: Tensor,
        sign: Tensor,
        num_generations: int,
        seed: int,
        parameters: Tensor | None = None,
        momentum: Tensor | None = None,
        generation: int = 0,
    ) -> None:
        """A search from no change, or from the parameters, momentum and generation of :meth:`state_dict`.

        Args:
            cfg: number of pairs and lengths.
            slots: slots that are changed, shape (S,).
            mean: of the hidden activations, shape (H,).
            directions: shape (D, H); a direction times an activation less the mean has unit variance.
            partner: index in ``slots`` of the same joint on the other side, shape (S,).
            sign: of a parameter in that joint, shape (S, D + 1).
            num_generations: over how many generations steps shrink.
            seed: of the perturbations.
            parameters: shape (S, D + 1).
            momentum: the same.
            generation: how many are done.
        """
        self.cfg, self.slots, self.mean, self.directions = cfg, slots, mean, directions
        self.partner, self.sign = partner, sign
        self.num_generations, self.seed, self.generation = num_generations, seed, generation
        zeros = torch.zeros_like(sign)
        self.parameters = zeros if parameters is None else parameters
        self.momentum = zeros if momentum is None else momentum

    @classmethod
    def along(
        cls,
        cfg: SearchCfg,
        hidden: Tensor,
        mirrored: Tensor,
        *,
        slots: Tensor,
        mirror: tuple[Tensor, Tensor],
        num_generations: int,
        seed: int,
    ) -> LastLayerSearch:
        """A search along directions that are the same, or the negative, in a mirror.

        Args:
            cfg: how many, at most.
            hidden: activations, shape (M, H).
            mirrored: those of the robots' mirror images, shape (M, H).
            slots: slots that are changed, shape (S,).
            mirror: permutation and signs (32,) of mirrored actions.
            num_generations: over how many generations steps shrink.
            seed: of the perturbations.
        """
        both = torch.cat((hidden, mirrored))
        mean = both.mean(dim=0)
        _, spread, principal = torch.linalg.svd(both - mean, full_matrices=False)
        keep = min(cfg.num_directions, int((spread > MIN_SPREAD * spread[0]).sum()))
        scaled = principal[:keep] * (math.sqrt(len(both)) / spread[:keep].unsqueeze(1))
        seen, imagined = ((x - mean) @ scaled.T for x in (hidden, mirrored))
        across = seen.T @ imagined / len(hidden)
        parity, turned = torch.linalg.eigh(0.5 * (across + across.T))
        clear = parity.abs() > MIN_PARITY
        perm, sign = mirror
        even_or_odd = torch.nn.functional.pad(parity[clear].sign(), (0, 1), value=1.0)
        return cls(
            cfg,
            slots=slots,
            mean=mean,
            directions=turned.T[clear] @ scaled,
            partner=partners(slots, perm),
            sign=sign[slots].unsqueeze(1) * even_or_odd,
            num_generations=num_generations,
            seed=seed,
        )

    def pairs(self) -> tuple[Tensor, Tensor]:
        """Parameters to try, one way and the other, each of shape (P, S, D + 1); the same until :meth:`learn`."""
        step = self.cfg.std * self._noise()
        return self.parameters + step, self.parameters - step

    def learn(self, better: Tensor) -> None:
        """Take a step.

        Args:
            better: by how much the cost of each first half is below that of its second half, shape (P,).
        """
        bound = OUTLIER * better.abs().median()
        weights = better.clamp(-bound, bound)
        gradient = torch.einsum("p,psd->sd", weights, self._noise())
        gradient /= gradient.norm().clamp(min=1e-12)
        self.momentum = MOMENTUM * self.momentum + (1.0 - MOMENTUM) * gradient
        left = 1.0 - (1.0 - FINAL_STEP) * self.generation / self.num_generations
        length = self.cfg.step * left * self.cfg.std * math.sqrt(self.parameters.numel())
        self.parameters = self.parameters + length * self.momentum / self.momentum.norm().clamp(min=1e-12)
        self.generation += 1

    def change(self, parameters: Tensor, hidden: Tensor, actions: Tensor) -> Tensor:
        """Actions (P, 32) with what parameters (P, S, D + 1), one of each environment, make of its activations."""
        inputs = torch.nn.functional.pad((hidden - self.mean) @ self.directions.T, (0, 1), value=1.0)
        return actions.index_add(1, self.slots, (parameters @ inputs.unsqueeze(2)).squeeze(2))

    @torch.no_grad()
    def fold_into(self, actor: EagleActor) -> None:
        """Add the present parameters to an actor's last layer: it then acts as ``change`` had it act."""
        last = actor.mlp[-1]
        weight = self.parameters[:, :-1] @ self.directions
        last.weight[self.slots] += weight
        last.bias[self.slots] += self.parameters[:, -1] - weight @ self.mean

    def _noise(self) -> Tensor:
        """Normal numbers of this generation, the same for left and right, (P, S, D + 1)."""
        generator = torch.Generator().manual_seed(self.seed + self.generation)
        noise = torch.randn(self.cfg.num_pairs, *self.parameters.shape, generator=generator).to(self.parameters)
        alone = self.partner == torch.arange(len(self.partner), device=self.partner.device)
        unit = torch.where(alone, 0.5, math.sqrt(0.5)).unsqueeze(1)
        return unit * (noise + self.sign * noise[:, self.partner])

    def state_dict(self) -> dict[str, Any]:
        """Arguments of the constructor, besides the configuration."""
        names = "slots mean directions partner sign num_generations seed parameters momentum generation".split()
        return {name: getattr(self, name) for name in names}
