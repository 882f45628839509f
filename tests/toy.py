"""A stand-in for the simulator: three robots must bring their pitch joints to the command, the others to zero.

``x' = x + GAIN a / m`` for the joints a robot has; the mass m is seen by the critic and must be estimated by the actor.
The task is its own mirror image. It honours the whole interface of the humanoid environment; its random numbers are its
own.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from envs.rng import CounterRng
from envs.robots.slots import MIRROR_PERMUTATION, MIRROR_SIGN, NUM_SLOTS

FRAMES = 3
ROBOTS = {"one": (12, 0.5), "two": (15, 0.7), "three": (32, 1.0)}
"""Joints and mass of each robot."""
EPISODE_LENGTH = 16
GAIN = 0.3
START = 0.2
"""Bound of the joints after a reset."""


class ToyEnv(VecEnv):
    """Pooled toy robots."""

    def __init__(
        self, num_envs: int = 24, robots: tuple[str, ...] = tuple(ROBOTS), seed: int = 0, waves: int = 0
    ) -> None:
        self.waves = torch.arange(1.0, waves + 1)
        self.num_envs, self.num_actions, self.device = num_envs, NUM_SLOTS, "cpu"
        self.max_episode_length, self.cfg, self.step_dt = EPISODE_LENGTH, {}, 0.02
        self.robot_names = list(robots)
        self.robot = torch.arange(num_envs) % len(robots)
        joints = torch.tensor([ROBOTS[name][0] for name in robots])[self.robot]
        self.mask = (torch.arange(NUM_SLOTS) < joints[:, None]).float()
        self.robots = SimpleNamespace(action_scale=self.mask)
        self.mass = torch.tensor([ROBOTS[name][1] for name in robots])[self.robot, None]
        names = [robots[i] for i in self.robot.tolist()]
        self.rng = CounterRng(seed, names, torch.arange(num_envs) // len(robots))
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
        self.resets = torch.zeros(num_envs, dtype=torch.long)
        self.pitch = (torch.tensor(MIRROR_SIGN) > 0).float()
        self.command = torch.zeros(num_envs, 5)
        self.frames = torch.zeros(num_envs, FRAMES, NUM_SLOTS)
        self._reset(torch.arange(num_envs))
        perm, sign = torch.tensor(MIRROR_PERMUTATION), torch.tensor(MIRROR_SIGN, dtype=torch.float32)
        identity = {"command": 5, "clock": 2 + waves, "critic": NUM_SLOTS + 6 + waves, "estimate": 33}
        self.mirror = {key: (torch.arange(n), torch.ones(n)) for key, n in identity.items()}
        self.mirror["actions"] = (perm, sign)
        self.mirror["history"] = (
            torch.cat([perm + frame * NUM_SLOTS for frame in range(FRAMES)]),
            sign.repeat(FRAMES),
        )

    def get_observations(self) -> TensorDict:
        current = self.frames[:, 0]
        speed = (current - self.frames[:, 1])[:, :3]
        phase = 0.1 * self.episode_length_buf
        waves = torch.sin(phase.unsqueeze(1) * self.waves)
        groups = {
            "history": self.frames.flatten(1).clone(),
            "command": self.command.clone(),
            "clock": torch.cat([torch.zeros(self.num_envs, 2), waves], dim=1),
            "critic": torch.cat([current, self.command, self.mass, waves], dim=1),
            "estimate": torch.cat([speed, self.mass * torch.linspace(0.1, 1.0, 30)], dim=1),
            "slot_mask": self.mask.clone(),
            "phase": phase,
            "robot": self.robot.clone(),
        }
        return TensorDict(groups, batch_size=[self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        moved = self.frames[:, 0] + GAIN * actions.clamp(-3, 3) / self.mass * self.mask
        self.frames = torch.cat([moved[:, None], self.frames[:, :-1]], dim=1)
        goal = self.command[:, :1] * self.pitch
        error = ((moved - goal).square() * self.mask).sum(1) / self.mask.sum(1)
        self.episode_length_buf = self.episode_length_buf + 1
        time_outs = self.episode_length_buf >= EPISODE_LENGTH
        falls = (error > 30.0) & ~time_outs
        final_ids = time_outs.nonzero().flatten()
        final = self.get_observations()[final_ids]
        self._reset((time_outs | falls).nonzero().flatten())
        log = {f"Metrics/error/{name}": error[self.robot == i].mean() for i, name in enumerate(self.robot_names)}
        extras = {"time_outs": time_outs, "log": log, "final_ids": final_ids, "final_observations": final}
        return self.get_observations(), -error, time_outs | falls, extras

    def stagger(self) -> None:
        self.episode_length_buf = torch.randint_like(self.episode_length_buf, EPISODE_LENGTH)

    def reset(self) -> None:
        self._reset(torch.arange(self.num_envs))

    def state_dict(self) -> dict[str, Any]:
        names = ("episode_length_buf", "resets", "command", "frames")
        return {name: getattr(self, name).clone() for name in names}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value.clone())

    def _reset(self, ids: Tensor) -> None:
        self.resets = self.resets.index_add(0, ids, torch.ones_like(ids))
        draw = self.rng.uniform_in(-1.0, 1.0, "reset", self.resets[ids], NUM_SLOTS + 5, ids)
        self.command = self.command.index_copy(0, ids, draw[:, NUM_SLOTS:])
        frames = (START * draw[:, None, :NUM_SLOTS] * self.mask[ids, None]).expand(-1, FRAMES, -1)
        self.frames = self.frames.index_copy(0, ids, frames.contiguous())
        self.episode_length_buf = self.episode_length_buf.index_fill(0, ids, 0)
