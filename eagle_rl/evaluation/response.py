"""Commanded and measured traces: each command in turn goes to its extremes and back while the others stay at zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from eagle_rl.config.schema import CommandsCfg, EvaluationCfg, TaskCfg
from eagle_rl.evaluation.evaluate import MakeEnv, Policy
from eagle_rl.evaluation.protocol import COMMANDS, evaluation_task, step_dt

HOLD_S = 3.0
"""Time at each level."""


@dataclass(frozen=True, kw_only=True)
class Response:
    """One robot's answer to the script of every command."""

    robot: str
    time: NDArray[np.float64]
    """[s], shape (T,)."""
    commanded: NDArray[np.float64]
    """Column d is command d in the run that varies it, shape (T, 5)."""
    measured: NDArray[np.float64]
    """The same as it was; NaN after a fall, shape (T, 5)."""


def script(commands: CommandsCfg, hold_steps: int) -> NDArray[np.float64]:
    """Zero, upper limit, lower limit, zero, each held for ``hold_steps``; shape (4 hold_steps, 5)."""
    limits = np.array([getattr(commands, name).finishing for name in COMMANDS])
    zero = np.zeros(len(COMMANDS))
    return np.repeat(np.stack([zero, limits[:, 1], limits[:, 0], zero]), hold_steps, axis=0)


@torch.inference_mode()
def command_responses(
    policy: Policy, make_env: MakeEnv, robots: Sequence[str], task: TaskCfg, ev: EvaluationCfg
) -> list[Response]:
    """Play the script on each robot; environment d varies command d."""
    hold_steps = round(HOLD_S / (ev.physics_dt * ev.decimation))
    commanded = script(task.commands, hold_steps)
    task = evaluation_task(task, replace(ev, num_steps=len(commanded)))
    return [_respond(policy, make_env, robot, task, ev, commanded) for robot in robots]


def _respond(
    policy: Policy, make_env: MakeEnv, robot: str, task: TaskCfg, ev: EvaluationCfg, commanded: NDArray[np.float64]
) -> Response:
    """One robot's response."""
    env = make_env([robot], len(COMMANDS), task, ev.seed)
    alive = torch.ones(len(COMMANDS), dtype=torch.bool)
    measured = np.full(commanded.shape, np.nan)
    for t, levels in enumerate(commanded):
        env.pin_commands(torch.diag(torch.tensor(levels)))
        _, _, dones, _ = env.step(policy(env.get_observations()))
        alive &= ~dones.bool().cpu()
        diagonal = env.measured_commands().diagonal().double().cpu()
        measured[t] = torch.where(alive, diagonal, torch.nan).numpy()
    time = np.arange(1, len(commanded) + 1, dtype=np.float64) * step_dt(task)
    return Response(robot=robot, time=time, commanded=commanded, measured=measured)
