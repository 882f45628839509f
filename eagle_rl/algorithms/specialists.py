"""The frozen specialists a generalist learns from (paper, Algorithm 1, lines 5-9)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.models.correction import Correction

CHUNK_ROWS = 16384
"""Rows labelled at once, to bound memory."""


class SpecialistBank:
    """One frozen specialist per robot; row i is judged by the specialist of ``obs["robot"][i]``."""

    def __init__(
        self, specialists: Sequence[EagleActor], corrections: Sequence[Correction | None] | None = None
    ) -> None:
        """Freeze ``specialists``, which are in the order of the environment's robots, each with its correction."""
        self.specialists = [actor.eval().requires_grad_(False) for actor in specialists]
        self.corrections = corrections or [None] * len(self.specialists)

    @torch.no_grad()
    def label(self, observations: TensorDict) -> dict[str, Tensor]:
        """What the specialists do at the visited states.

        Args:
            observations: the generalist's rollout, batch size (T, N).

        Returns:
            ``teacher_action``, ``teacher_std`` (T, N, 32), zero in absent slots, and ``teacher_embedding`` (T, N, E).
        """
        chunks = [self._label_rows(rows) for rows in observations.flatten(0, 1).split(CHUNK_ROWS)]
        size = observations.batch_size
        return {key: torch.cat([chunk[key] for chunk in chunks]).unflatten(0, size) for key in chunks[0]}

    def _label_rows(self, obs: TensorDict) -> dict[str, Tensor]:
        mask = obs["slot_mask"]
        embedding_dim = self.specialists[0].architecture["networks"]["embedding_dim"]
        action, std = torch.empty_like(mask), torch.empty_like(mask)
        embedding = mask.new_empty(len(mask), embedding_dim)
        for robot, (specialist, correction) in enumerate(zip(self.specialists, self.corrections, strict=True)):
            rows = (obs["robot"] == robot).nonzero(as_tuple=True)[0]
            inputs = (obs[group][rows] for group in ACTOR_INPUTS)
            mean, embedding[rows], _ = specialist.outputs(*inputs)
            action[rows] = mean * mask[rows] if correction is None else correction.act(specialist, obs[rows])
            std[rows] = specialist.distribution.std_param.clamp(*specialist.distribution.std_range) * mask[rows]
        return {"teacher_action": action, "teacher_std": std, "teacher_embedding": embedding}
