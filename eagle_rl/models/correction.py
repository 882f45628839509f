"""A policy with a correction: what is added to its command and its action.

A part of it depends on command and phase alone; a smaller one answers the error of the yaw rate. These are made in
passes, each of which is trusted where it was seen to help. On top comes what errors that are foreseen ask for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import torch
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.models.actor import ACTOR_INPUTS, EagleActor
from eagle_rl.models.basis import monomials, waves
from eagle_rl.models.foresight import Foresight

NUM_HARMONICS = 5
"""Highest multiple of the gait's frequency that is added to an action; 50 Hz make 20 to 25 steps of a cycle."""
NUM_SHIFTS = 3
"""The commands a policy can be told more or less of: its velocities, which it follows by itself. What it is told of a
posture hardly moves it, since its resting pose is bent (docs/experiments.md, 22)."""
SHIFT_UNIT = 5.0
"""Change of a scaled command by a coefficient of 1 [-]: one of an action and one of a command then weigh alike."""
NUM_FEET = 2
"""Leading columns of the clock: the sine of each foot's phase."""
STANDING_CLOCK = 0.999
"""Both feet's sines are above this only where the robot stands, which is not corrected."""
FEEDBACK_HARMONICS = 1
"""Of the gait, by which a gain may vary: a foot in stance can turn the pelvis, one in swing cannot."""
YAW = 2
"""Column of the yaw rate in the newest frame, and of its command."""
DOUBT = 0.05
"""Harm, and help, within which trust passes from nearly all to nearly nothing [error units]."""
_FORESIGHT = "foresight."
"""What the names of its tensors begin with."""
TRUSTED = -1.0
"""Harm expected of a new pass at every command, until something is known about it [error units]."""


@dataclass(frozen=True)
class Correction:
    """Coefficients of :func:`waves` for every joint, and of the commands, as polynomials of the command; gains.

    Those of I passes add up.
    """

    weights: Tensor
    """Of the monomials, shape (I, 56, S (2 NUM_HARMONICS + 1) + NUM_SHIFTS)."""
    slots: Tensor
    """Slots that are corrected, shape (S,)."""
    units: Tensor
    """Action by which a coefficient of 1 changes each of them, shape (S,): the same angle, whatever an action's is."""
    middle: Tensor
    """Of the scaled commands' ranges, shape (5,)."""
    half_range: Tensor
    """Half the width of those, shape (5,)."""
    gains: Tensor
    """Units per error of the yaw rate [s/rad], times :func:`waves`, shape (I, S, 2 FEEDBACK_HARMONICS + 1)."""
    harm: Tensor
    """Weights of the monomials: by how much a pass makes following worse [error units], shape (I, 56)."""
    yaw_scales: Tensor
    """Of the yaw rate and of its command in the observations, shape (2,)."""
    foresight: Foresight | None = None
    """Answers errors that are about to come."""

    def normalised(self, command: Tensor) -> Tensor:
        """Scaled commands (N, 5) as shares of their ranges, in [-1, 1]; beyond these a polynomial would run away."""
        return ((command - self.middle) / self.half_range).clamp(-1.0, 1.0)

    def at(self, command: Tensor) -> tuple[Tensor, Tensor]:
        """Coefficients (N, S (2 NUM_HARMONICS + 1) + NUM_SHIFTS) and gains (N, S, ...) at scaled commands (N, 5)."""
        basis = monomials(self.normalised(command))
        trust = torch.sigmoid(basis @ self.harm.T / -DOUBT)
        trusted = (trust.unsqueeze(2) * basis.unsqueeze(1)).flatten(1)
        return trusted @ self.weights.flatten(0, 1), torch.einsum("ni,isw->nsw", trust, self.gains)

    def with_pass(self) -> Correction:
        """The same, and one more pass, which as yet adds nothing."""
        harm = self.harm.new_zeros(1, self.harm.shape[1])
        harm[:, 0] = TRUSTED
        return replace(
            self,
            weights=torch.cat((self.weights, self.weights.new_zeros(1, *self.weights.shape[1:]))),
            gains=torch.cat((self.gains, self.gains.new_zeros(1, *self.gains.shape[1:]))),
            harm=torch.cat((self.harm, harm)),
        )

    def last(self, **fields: Tensor) -> Correction:
        """The same with other ``weights``, ``gains`` or ``harm`` of the last pass."""
        changed = {name: torch.cat((getattr(self, name)[:-1], x[None])) for name, x in fields.items()}
        return replace(self, **changed)  # type: ignore[arg-type]  # of tensors, which no foresight is

    def yaw_error(self, history: Tensor, command: Tensor) -> Tensor:
        """How much faster the robot turns than it is told to, as its gyroscope says [rad/s], shape (N,)."""
        return history[:, YAW] / self.yaw_scales[0] - command[:, YAW] / self.yaw_scales[1]

    def act(
        self,
        actor: EagleActor,
        obs: TensorDict,
        extra: Tensor | float = 0.0,
        extra_gains: Tensor | float = 0.0,
        extra_actions: Tensor | float = 0.0,
    ) -> Tensor:
        """Mean actions (N, 32) of the corrected policy.

        Args:
            actor: the policy.
            obs: the groups it reads, ``slot_mask`` and ``phase``.
            extra: added to the coefficients, the same shape.
            extra_gains: added to the gains, shape (N, S, 2 FEEDBACK_HARMONICS + 1).
            extra_actions: added to the actions, in units, shape (N, S).
        """
        history, command, clock = (obs[group] for group in ACTOR_INPUTS)
        walks = clock[:, :NUM_FEET].amin(dim=1, keepdim=True) < STANDING_CLOCK
        coefficients, gains = self.at(command)
        coefficients = (coefficients + extra) * walks
        shift = torch.zeros_like(command)
        shift[:, :NUM_SHIFTS] = SHIFT_UNIT * coefficients[:, -NUM_SHIFTS:]
        actions = actor.mean_actions(history, command + shift, clock, obs["slot_mask"])
        by_joint = coefficients[:, :-NUM_SHIFTS].unflatten(1, (len(self.slots), -1))
        waving = waves(obs["phase"], NUM_HARMONICS).unsqueeze(1)
        more = (by_joint * waving).sum(dim=2)
        gain = ((gains + extra_gains) * waving[..., : gains.shape[2]]).sum(dim=2)
        more += (gain * self.yaw_error(history, command).unsqueeze(1) + extra_actions) * walks
        if self.foresight is not None:
            basis = monomials(self.normalised(command))
            more += self.foresight.change(history, obs["phase"], basis) * walks
        return actions.index_add(1, self.slots, self.units * more)

    def state_dict(self) -> dict[str, Tensor]:
        """Arguments of the constructor, and those of the foresight's with its name before theirs."""
        own = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "foresight"}
        ahead = self.foresight.state_dict() if self.foresight else {}
        return own | {f"{_FORESIGHT}{name}": x for name, x in ahead.items()}

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor]) -> Correction:
        """What :meth:`state_dict` was made of.

        Raises:
            TypeError: names are missing, or others are there.
        """
        own = {name: x for name, x in state.items() if not name.startswith(_FORESIGHT)}
        ahead = {name.removeprefix(_FORESIGHT): x for name, x in state.items() if name not in own}
        return cls(**own, foresight=Foresight(**ahead) if ahead else None)


class CorrectedPolicy:
    """The deterministic policy of actor and correction together."""

    def __init__(self, actor: EagleActor, correction: Correction) -> None:
        """Correct ``actor``."""
        self.actor, self.correction = actor, correction

    def __call__(self, obs: TensorDict) -> Tensor:
        """Mean actions, shape (N, 32)."""
        return self.correction.act(self.actor, obs)
