"""A policy at work on several robots, one environment each: what ``eagle play`` shows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.evaluation.protocol import evaluation_task
from envs.humanoid_env import HumanoidEnv
from envs.robots.load import load_robot

if TYPE_CHECKING:
    from eagle_rl.evaluation.evaluate import Policy

Array = NDArray[np.float64]


class Session:
    """Robots under one deterministic policy and one command, in the task as it is evaluated, on flat ground.

    A robot that falls starts again where it began.

    Attributes:
        cfg: the experiment the policy comes from.
        specs: the robots.
        step_dt: control step [s].
        falls: times [s] at which each robot fell, by name.
    """

    def __init__(self, policy: Policy, cfg: ExperimentCfg, robots: Sequence[str], num_steps: int) -> None:
        """Place one environment per robot; none times out within ``num_steps`` control steps."""
        self.cfg = cfg
        self.specs = [load_robot(name) for name in robots]
        protocol = dataclasses.replace(cfg.evaluation, num_steps=num_steps, randomization=False, noise=False)
        task = evaluation_task(cfg.task, protocol)
        self._env = HumanoidEnv(task, self.specs, len(self.specs), protocol.seed, num_threads=1)
        self._policy = policy
        self.step_dt = self._env.step_dt
        self.num_steps = 0
        self.falls: dict[str, list[float]] = {spec.name: [] for spec in self.specs}

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self.num_steps * self.step_dt

    @property
    def qpos(self) -> list[Array]:
        """Root position [m], quaternion (w, x, y, z) and joint angles [rad] of each robot."""
        return [batch.qpos[0] for batch in self._env.pool.batches]

    @property
    def measured(self) -> Array:
        """What each command asks for, as it is [m/s, m/s, rad/s, m, rad], shape (num_robots, 5)."""
        return self._env.measured_commands().double().numpy()

    @torch.inference_mode()
    def step(self, command: Array) -> None:
        """Advance one control step under a command for all, shape (5,)."""
        rows = torch.as_tensor(command, dtype=torch.float32).expand(len(self.specs), 5)
        self._env.pin_commands(rows)
        _, _, dones, _ = self._env.step(self._policy(self._env.get_observations()))
        self.num_steps += 1
        for row in dones.nonzero().flatten().tolist():
            self.falls[self.specs[row].name].append(self.time)


def caption(time: float, command: Array) -> str:
    """Time and command in words."""
    vx, vy, wz, h, p = command
    walk = f"forward {vx:+.2f} m/s   left {vy:+.2f} m/s   turn {wz:+.2f} rad/s"
    return f"{time:5.1f} s    {walk}   height {h:+.2f} m   pitch {p:+.2f} rad"
