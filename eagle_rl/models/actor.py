"""The policy: history encoder, estimator of privileged quantities, policy head (paper, Fig. 2; HugWBC 6)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
from tensordict import TensorDict
from torch import Tensor, nn

from eagle_rl.models.distribution import MaskedGaussian
from eagle_rl.models.sides import MirrorMap, Sides

ACTOR_INPUTS = ("history", "command", "clock")
"""Observation groups of the policy, in the order the policy head and the exported module take them."""
SIDED_GROUPS = (*ACTOR_INPUTS, "actions")
"""What a two-sided policy mirrors."""


class EagleActor(MLPModel):
    """Policy head on [e(s_t), estimate, current frame, command, clock], in slot space.

    The estimate is not detached: PPO's gradient reaches estimator and encoder. After a forward pass ``embedding``,
    e(s_t) of shape (N, E), and ``estimate`` (N, 3 or 33) can be read, as the distribution can.

    A two-sided actor's mean is (mu(o) + M mu(M o)) / 2, with M the left/right mirror: it does the same to the left and
    to the right, exactly. Embedding and estimate are those of o.
    """

    embedding: Tensor
    estimate: Tensor

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        history_length: int,
        hidden_dims: Sequence[int],
        encoder_dims: Sequence[int],
        estimator_dims: Sequence[int],
        embedding_dim: int,
        activation: str,
        init_std: float,
        std_range: tuple[float, float],
        mirror: MirrorMap | None = None,
    ) -> None:
        """Build the networks for the widths of the groups in ``obs``.

        ``history_length`` is K, the number of frames in the history group, newest first; the groups of the set
        ``estimate`` are what the estimator predicts; ``mirror`` makes the actor two-sided.
        """
        dims = {group: obs[group].shape[-1] for group in (*ACTOR_INPUTS, "estimate")}
        if tuple(obs_groups[obs_set]) != ACTOR_INPUTS or dims["history"] % history_length:
            raise ValueError(
                f"The actor reads {ACTOR_INPUTS} with a history of {history_length} equal frames; "
                f"got {obs_groups[obs_set]} with a history of {dims['history']} numbers."
            )
        self.frame_dim = dims["history"] // history_length
        self._latent_dim = embedding_dim + sum(dims.values()) - dims["history"] + self.frame_dim
        distribution = {"class_name": MaskedGaussian, "init_std": init_std, "std_range": tuple(std_range)}
        super().__init__(obs, obs_groups, obs_set, output_dim, tuple(hidden_dims), activation, False, distribution)
        self.encoder = MLP(dims["history"], embedding_dim, tuple(encoder_dims), activation)
        self.estimator = MLP(embedding_dim, dims["estimate"], tuple(estimator_dims), activation)
        self.sides = Sides({group: mirror[group] for group in SIDED_GROUPS}) if mirror else None
        self.architecture: dict[str, Any] = {
            "observations": dims,
            "num_actions": output_dim,
            "networks": {
                "history_length": history_length,
                "hidden_dims": list(hidden_dims),
                "encoder_dims": list(encoder_dims),
                "estimator_dims": list(estimator_dims),
                "embedding_dim": embedding_dim,
                "activation": activation,
                "init_std": init_std,
                "std_range": list(std_range),
            },
            "mirror": self.sides.to_lists() if self.sides else None,
        }
        """Numbers from which :meth:`from_architecture` builds the same actor, without an environment."""

    @classmethod
    def from_architecture(cls, architecture: dict[str, Any]) -> EagleActor:
        """An untrained actor of the same shape."""
        dims = architecture["observations"]
        obs = TensorDict({group: torch.zeros(1, dim) for group, dim in dims.items()}, batch_size=[1])
        groups = {"actor": list(ACTOR_INPUTS), "estimate": ["estimate"]}
        actor = cls(obs, groups, "actor", architecture["num_actions"], **architecture["networks"])
        return actor.with_sides(architecture.get("mirror"))

    def with_sides(self, mirror: dict[str, Any] | None) -> EagleActor:
        """This actor, two-sided by what ``architecture["mirror"]`` holds, or one-sided."""
        self.sides = Sides.from_lists(mirror) if mirror else None
        self.architecture["mirror"] = mirror
        return self

    def forward(
        self,
        obs: TensorDict,
        masks: Tensor | None = None,
        hidden_state: object = None,
        stochastic_output: bool = False,
    ) -> Tensor:
        """Mean actions or, if ``stochastic_output``, a sample, shape (N, 32)."""
        self.distribution.mask = obs["slot_mask"]
        mean, self.embedding, self.estimate = self.outputs(*(obs[group] for group in ACTOR_INPUTS))
        if not stochastic_output:
            return self.distribution.deterministic_output(mean)
        self.distribution.update(mean)
        return self.distribution.sample()

    def features(self, history: Tensor, command: Tensor, clock: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Input of the policy head (N, L), embedding (N, E) and estimate; leaves no trace in the actor."""
        embedding = self.encoder(history)
        estimate = self.estimator(embedding)
        latent = torch.cat([embedding, estimate, history[:, : self.frame_dim], command, clock], dim=-1)
        return latent, embedding, estimate

    def outputs(
        self,
        history: Tensor,
        command: Tensor,
        clock: Tensor,
        last_layer: Callable[[Tensor], Tensor] | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Mean actions (N, 32) before the mask, embedding (N, E) and estimate; leaves no trace in the actor.

        ``last_layer`` takes the place of the policy head's, which makes actions of activations (N, H).
        """

        def head(latent: Tensor) -> Tensor:
            return self.mlp(latent) if last_layer is None else last_layer(self._hidden(latent))

        latent, embedding, estimate = self.features(history, command, clock)
        mean = head(latent)
        if self.sides is not None:
            inputs = zip(ACTOR_INPUTS, (history, command, clock), strict=True)
            seen = (self.sides.mirrored(group, x) for group, x in inputs)
            mean = 0.5 * (mean + self.sides.mirrored("actions", head(self.features(*seen)[0])))
        return mean, embedding, estimate

    def mean_actions(self, history: Tensor, command: Tensor, clock: Tensor, slot_mask: Tensor) -> Tensor:
        """Mean actions (N, 32) of other observations; leaves no trace in the actor."""
        return self.outputs(history, command, clock)[0] * slot_mask

    def hidden(self, obs: TensorDict) -> Tensor:
        """Activations (N, H), of these observations alone, before the policy head's last layer; leaves no trace."""
        return self._hidden(self.features(*(obs[group] for group in ACTOR_INPUTS))[0])

    def as_onnx(self, verbose: bool = False) -> nn.Module:
        """Exportable copy: (history, command, clock, slot_mask) -> (actions, estimate, embedding)."""
        return ExportedActor(copy.deepcopy(self))

    def _hidden(self, latent: Tensor) -> Tensor:
        """Activations (N, H) before the policy head's last layer."""
        return nn.Sequential(*list(self.mlp)[:-1])(latent)

    def _get_latent_dim(self) -> int:
        return self._latent_dim

    def __getstate__(self) -> dict[str, Any]:
        """State without the last forward pass, whose graph cannot be copied."""
        return {key: value for key, value in self.__dict__.items() if key not in ("embedding", "estimate")}


class ExportedActor(nn.Module):
    """The deterministic policy of tensors, for ONNX."""

    input_names = (*ACTOR_INPUTS, "slot_mask")
    output_names = ("actions", "estimate", "embedding")

    def __init__(self, actor: EagleActor) -> None:
        """Take over ``actor``."""
        super().__init__()
        self.actor = actor
        dims = actor.architecture["observations"]
        self.input_dims = (*(dims[group] for group in ACTOR_INPUTS), actor.architecture["num_actions"])

    def forward(
        self, history: Tensor, command: Tensor, clock: Tensor, slot_mask: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Mean actions (N, 32), estimate and embedding."""
        mean, embedding, estimate = self.actor.outputs(history, command, clock)
        return mean * slot_mask, estimate, embedding

    def get_dummy_inputs(self) -> tuple[Tensor, ...]:
        """Inputs of the right shapes, batch size 1."""
        return tuple(torch.zeros(1, dim) for dim in self.input_dims)
