"""Environments whose tracking errors are known in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.config.schema import TaskCfg


class ScriptedEnv:
    """The measured velocity, height and pitch of a robot are its first five actions; it falls when told to."""

    def __init__(self, num_envs: int, task: TaskCfg, fall_at: int | None = None) -> None:
        self.num_envs = num_envs
        self.task = task
        self.fall_at = fall_at
        self.t = 0
        self.command = torch.full((num_envs, 5), torch.nan)
        self.measured = torch.zeros(num_envs, 5)
        self.slot_names = tuple(f"joint_{i}" for i in range(32))
        self.gravity = torch.tensor([0.0, 0.0, -1.0]).repeat(num_envs, 1)
        self.at_stop = torch.zeros(num_envs, 32, dtype=torch.bool)

    def pin_commands(self, command: Tensor | None) -> None:
        assert command is not None
        self.command = command.float()

    def get_observations(self) -> TensorDict:
        return TensorDict({"command": self.command.clone()}, batch_size=[self.num_envs])

    def reset(self) -> None:
        self.t = 0

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        self.t += 1
        self.measured = actions[:, :5]
        dones = torch.full((self.num_envs,), self.t == self.fall_at)
        extras = {"time_outs": torch.zeros(self.num_envs, dtype=torch.bool)}
        return self.get_observations(), torch.zeros(self.num_envs), dones, extras

    def tracking_errors(self) -> Tensor:
        return (self.measured - self.command).abs()

    def balance(self) -> tuple[Tensor, Tensor]:
        return self.gravity, self.at_stop


def make_scripted_env(robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first: int = 0) -> ScriptedEnv:
    """The ``make_env`` of an evaluation."""
    return ScriptedEnv(num_envs, task)


def perfect(obs: TensorDict) -> Tensor:
    """A policy that measures exactly what is commanded."""
    return torch.nn.functional.pad(obs["command"], (0, 27))


def idle(obs: TensorDict) -> Tensor:
    """A policy that stands still."""
    return torch.zeros(len(obs), 32)
