"""Errors a walking robot is about to make, and the small change of its action that answers them before they are there.

The errors of the next tenth of a second are regressed on what the policy sees and on what is added to its action
(docs/experiments.md, 26); least squares then says what to add. It is a model-predictive controller without a model of
the body: its prediction and its answer are linear, with coefficients that follow the gait.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from eagle_rl.models.basis import products, waves

REPEATED_HARMONICS = 10
"""Of the gait, in the part of the errors that repeats at each command."""
HISTORY_HARMONICS = 1
"""Of the gait, by which the weights of the history may vary."""
ANSWER_HARMONICS = 2
"""Of the gait, by which the answer to a change of the action may vary."""
MAX_DEVIATION = 5.0
"""Of an entry of the history, beyond which it counts no more [standard deviations]."""
MAX_CHANGE = 0.5
"""Of an action, in multiples of the correction's units."""


@dataclass(frozen=True)
class Foresight:
    """Prediction and answer of one robot; F features, Z errors ahead (five of each step), S joints."""

    columns: Tensor
    """Of the history that are looked at, shape (G,)."""
    mean: Tensor
    """Of these, shape (G,)."""
    scale: Tensor
    """Their standard deviations, shape (G,)."""
    weights: Tensor
    """Of :meth:`features`, for the errors ahead in multiples of their units, shape (F, Z)."""
    answer: Tensor
    """Of these errors to a change of each action by a unit, times :func:`waves`, shape (W, S, Z)."""
    damping: Tensor
    """Number of error units that weigh as much as a change of 1, shape (); the less, the more noise is answered."""

    def features(self, history: Tensor, phase: Tensor, basis: Tensor) -> Tensor:
        """What errors are regressed on.

        Args:
            history: the observation group, shape (..., H).
            phase: of the gait [cycles], shape (...).
            basis: monomials of the command, shape (..., 56).

        Returns:
            Shape (..., F).
        """
        seen = ((history[..., self.columns] - self.mean) / self.scale).clamp(-MAX_DEVIATION, MAX_DEVIATION)
        repeated = products(waves(phase, REPEATED_HARMONICS), basis)
        return torch.cat((repeated, products(waves(phase, HISTORY_HARMONICS), seen)), dim=-1)

    def change(self, history: Tensor, phase: Tensor, basis: Tensor) -> Tensor:
        """What to add to the actions of N robots, in the correction's units, shape (N, S); arguments as above."""
        ahead = self.features(history, phase, basis) @ self.weights
        answer = torch.einsum("nw,wsz->nsz", waves(phase, ANSWER_HARMONICS), self.answer)
        normal = answer.mT @ answer + self.damping.square() * torch.eye(answer.shape[2]).to(answer)
        least = torch.linalg.solve(normal, ahead.unsqueeze(-1))
        return -(answer @ least).squeeze(-1).clamp(-MAX_CHANGE, MAX_CHANGE)

    def state_dict(self) -> dict[str, Tensor]:
        """Arguments of the constructor."""
        return {field.name: getattr(self, field.name) for field in fields(self)}
