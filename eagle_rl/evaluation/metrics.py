"""Tracking errors, summed per environment in float64 so that no total depends on how environments were batched.

What happens after a fall: an environment's own errors stop with the last step before it. ``charged`` errors go on: each
missing step is charged what a robot standing still would score, |c_d|, so that falling early never pays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from eagle_rl.evaluation.falls import Fall
from eagle_rl.evaluation.protocol import COMMANDS

SUBSETS = ("all", "settled", "standing", "walking", "squatting", "leaning")
"""Every step; steps at least 1 s after the command began; then by command: standing is planar speed and yaw rate inside
the training dead zones (0.15 m/s, 0.15 rad/s), walking the rest, squatting h < -0.15 m, leaning |p| > 0.2 rad."""

SETTLING_TIME_S = 1.0
STANDING_LIN_VEL = 0.15
STANDING_ANG_VEL = 0.15
SQUATTING_HEIGHT = -0.15
LEANING_PITCH = 0.2


def subset_members(command: Tensor, settled: bool) -> Tensor:
    """Which of SUBSETS each environment is in while it follows its command, bool, shape (N, 6)."""
    standing = (command[:, :2].norm(dim=1) <= STANDING_LIN_VEL) & (command[:, 2].abs() <= STANDING_ANG_VEL)
    everyone = torch.ones_like(standing)
    squatting = command[:, 3] < SQUATTING_HEIGHT
    leaning = command[:, 4].abs() > LEANING_PITCH
    return torch.stack([everyone, everyone & settled, standing, ~standing, squatting, leaning], dim=1)


@dataclass(frozen=True, kw_only=True)
class TrackingErrors:
    """Errors of one subset of steps, in the order of COMMANDS; None where the subset holds no step."""

    share: float
    """Share of all commanded steps that are in the subset."""
    errors: tuple[float | None, ...]
    """Mean absolute error while upright [m/s, m/s, rad/s, m, rad]."""
    charged: tuple[float | None, ...]
    """The same over all commanded steps, those after a fall charged |c_d|."""


@dataclass(frozen=True, kw_only=True)
class RobotMetrics:
    """What one robot scored."""

    num_envs: int
    survival: float
    """Share of environments that never fell."""
    upright: float
    """Share of commanded steps before any fall."""
    subsets: Mapping[str, TrackingErrors]
    falls: tuple[Fall, ...] = ()
    """First falls, the earliest first; earlier versions did not keep them."""

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> RobotMetrics:
        """Read back what ``dataclasses.asdict`` wrote to JSON."""
        subsets = {
            name: TrackingErrors(share=s["share"], errors=tuple(s["errors"]), charged=tuple(s["charged"]))
            for name, s in data["subsets"].items()
        }
        return cls(
            num_envs=data["num_envs"],
            survival=data["survival"],
            upright=data["upright"],
            subsets=subsets,
            falls=tuple(map(Fall.from_dict, data.get("falls", ()))),
        )


def _mean(total: Tensor, steps: Tensor) -> tuple[float | None, ...]:
    """Per-command means, None where nothing was counted."""
    return tuple(t / n if n else None for t, n in zip(total.tolist(), steps.tolist(), strict=True))


class TrackingAccumulator:
    """Sums of absolute errors of N environments of one robot."""

    def __init__(self, judged: Tensor) -> None:
        """Start with nobody fallen.

        Args:
            judged: commands on which each environment is judged, bool, shape (N, 5).
        """
        shape = (len(judged), len(SUBSETS), len(COMMANDS))
        self.judged = judged
        self.alive = torch.ones(len(judged), dtype=torch.bool)
        self.error, self.steps, self.charge, self.commanded = torch.zeros(4, *shape, dtype=torch.float64)

    def add(self, errors: Tensor, command: Tensor, fell: Tensor, settled: bool) -> None:
        """Count one control step.

        Args:
            errors: absolute errors after the step, shape (N, 5); anything in the rows of the fallen.
            command: what was commanded during the step, shape (N, 5).
            fell: whether the episode ended in this step other than by time-out, bool, shape (N,).
            settled: whether the command is at least SETTLING_TIME_S old.
        """
        self.alive &= ~fell
        judged = subset_members(command, settled).unsqueeze(2) & self.judged.unsqueeze(1)
        upright = judged & self.alive[:, None, None]
        absent = (judged & ~upright) * command.abs().double().unsqueeze(1)
        counted = torch.where(upright, errors.double().unsqueeze(1), 0.0)
        self.error += counted
        self.steps += upright
        self.charge += counted + absent
        self.commanded += judged

    def finish(self) -> RobotMetrics:
        """Means over all environments and steps."""
        error, steps, charge, commanded = (x.sum(0) for x in (self.error, self.steps, self.charge, self.commanded))
        total = commanded[0].sum()
        subsets = {
            name: TrackingErrors(
                share=(commanded[i].sum() / total).item(),
                errors=_mean(error[i], steps[i]),
                charged=_mean(charge[i], commanded[i]),
            )
            for i, name in enumerate(SUBSETS)
        }
        return RobotMetrics(
            num_envs=len(self.alive),
            survival=self.alive.double().mean().item(),
            upright=(steps[0].sum() / total).item(),
            subsets=subsets,
        )

    @staticmethod
    def join(parts: list[TrackingAccumulator]) -> TrackingAccumulator:
        """One accumulator of the environments of several, in their order."""
        joined = TrackingAccumulator(torch.cat([part.judged for part in parts]))
        for name in ("alive", "error", "steps", "charge", "commanded"):
            setattr(joined, name, torch.cat([getattr(part, name) for part in parts]))
        return joined
