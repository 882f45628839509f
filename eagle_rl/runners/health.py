"""The learner's own checks on what the environment hands it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from eagle_rl.errors import HealthError

MAX_MAGNITUDE = 1e6
"""Largest number an environment may hand over, in any observation or reward [-]; sound ones stay below 1e3."""
SICK_LIMIT = 1e-3
"""Most environment steps of a robot that may end in sickness, as a share [-]."""
SICK_WINDOW = 10
"""Iterations over which the share is taken."""
SICK_MINIMUM = 10
"""Sick environments below which the share says nothing: in a small pool one is already above the limit."""


def require_sound(tensors: Mapping[str, Tensor], robot: Tensor, robot_names: Sequence[str]) -> None:
    """Raise :class:`HealthError` if a number is not finite or is absurd, naming tensor, robots and environments.

    Args:
        tensors: float tensors by name, rows are environments.
        robot: index of each environment's robot, shape (N,).
        robot_names: names of the robots.
    """
    extremes = torch.stack([x for tensor in tensors.values() for x in torch.aminmax(tensor)])  # one pass; NaN stays NaN
    if (extremes.abs() <= MAX_MAGNITUDE).all():
        return
    for name, tensor in tensors.items():
        wrong = ~(tensor.reshape(len(tensor), -1).abs() <= MAX_MAGNITUDE)
        bad = wrong.any(dim=1).nonzero().flatten()
        if len(bad):
            names = sorted({robot_names[i] for i in robot[bad].tolist()})
            column = int(wrong[bad[0]].nonzero()[0])
            value = tensor[bad[0]].reshape(-1)[column].item()
            fault = "absurd" if math.isfinite(value) else "not finite"
            raise HealthError(
                f"{name} is {fault}: {value} in column {column}; robots {', '.join(names)}; "
                f"environments {bad[:16].tolist()}{' ...' if len(bad) > 16 else ''}. "
                "The environment let an unsound state through; look at Health/* of the last iterations."
            )


class SickRule:
    """Stops a run in which the environments of a robot keep falling ill."""

    def __init__(self, env_steps: Mapping[str, int], fault_folder: Path | None) -> None:
        """Start with an empty window.

        Args:
            env_steps: environment steps of each robot in an iteration, by its name.
            fault_folder: where the environment keeps the last states of the sick, for the message.
        """
        self._env_steps = env_steps
        self._fault_folder = fault_folder
        self._shares = {name: deque([0.0] * SICK_WINDOW, maxlen=SICK_WINDOW) for name in env_steps}

    def check(self, scalars: Mapping[str, float]) -> None:
        """Take the scalars of one iteration, of which ``Health/*`` count.

        Raises:
            HealthError: the share of sick environment steps of a robot is above ``SICK_LIMIT``.
        """
        for name, shares in self._shares.items():
            shares.append(scalars.get(f"Health/sick_share/{name}", 0.0))
            share = sum(shares) / SICK_WINDOW
            if share > SICK_LIMIT and share * SICK_WINDOW * self._env_steps[name] >= SICK_MINIMUM:
                raise HealthError(self._message(name, share, scalars))

    def _message(self, name: str, share: float, scalars: Mapping[str, float]) -> str:
        tags = [tag.split("/") for tag, n in scalars.items() if n > 0 and tag.endswith(f"/{name}")]
        causes = [cause for group, cause, *_ in tags if group == "Health" and cause != "sick_share"]
        counts = ", ".join(f"{cause} {scalars[f'Health/{cause}/{name}']:g}" for cause in causes)
        kept = ""
        if self._fault_folder is not None:
            kept = f" What they did last is in {self._fault_folder}; show it with: play.py --replay-fault FILE."
        return (
            f"{name}: {share:.2%} of its environment steps in the last {SICK_WINDOW} iterations ended in a sick "
            f"environment, more than {SICK_LIMIT:.2%} (last iteration: {counts or 'none'}).{kept} Where the cause is "
            "action, the policy has come apart: lower algo.learning_rate. Otherwise the physics has: halve "
            "task.sim.physics_dt and double task.sim.decimation, or look for overlapping collision shapes with "
            "eagle robots check."
        )
