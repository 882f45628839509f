"""Domain randomization, per environment and from named streams (HugWBC 8)."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from eagle_rl.config.schema import RandomizationCfg, Range

from ..geometry import quat_from_yaw
from ..rng import CounterRng
from ..robots.slots import NUM_SLOTS
from ..sim.pool import PhysicsPool
from ..state import PooledRobots
from .bodies import draw_morphology, randomize_bodies, resized

NOMINAL_FRICTION = 1.0
SPAWN_CLEARANCE = 0.04
"""Height above the default pose at which a robot is spawned [m] (HugWBC 2)."""


Step = TypeVar("Step", int, Tensor)


class Draws(NamedTuple):
    """What is drawn anew at each reset, a row for each of some environments."""

    friction: Tensor
    """Shape (n,)."""
    motor_offset: Tensor
    """Canonical [rad], shape (n, 32)."""
    latency: Tensor
    """Share of the control step, shape (n, 1)."""
    stiffness_scale: Tensor
    """Shape (n, 32)."""
    damping_scale: Tensor
    """Shape (n, 32)."""


class Randomizer:
    """Draws and applies every row of the randomization table; nominal values where a row is off."""

    def __init__(self, cfg: RandomizationCfg, pool: PhysicsPool, robots: PooledRobots, rng: CounterRng) -> None:
        """Draw the bodies of every environment; the rest follows at each reset."""
        self.cfg = cfg
        self._pool = pool
        self._rng = rng
        length, mass = draw_morphology(cfg, robots, rng)
        self.robots = resized(robots, length, mass)
        """The robots as their morphology makes them."""
        self.bodies = randomize_bodies(cfg, pool, self.robots, rng, length, mass)
        """What became of the links that o_ea describes."""
        num_envs = len(mass)
        self.friction = torch.full_like(mass, NOMINAL_FRICTION)
        """Friction coefficient, shape (N,)."""
        self.motor_offset = mass.new_zeros(num_envs, NUM_SLOTS)
        """Offset of the PD targets, canonical [rad], shape (N, 32)."""
        self.latency = mass.new_zeros(num_envs, 1)
        """Age of the proprioception as a share of the control step, shape (N, 1)."""
        self.reset_keys, self.start_keys = rng.keys("reset"), rng.keys("initial_state")
        """Of the random streams, shape (N,)."""
        self._stiffness_scale = mass.new_ones(num_envs, NUM_SLOTS)
        self._damping_scale = mass.new_ones(num_envs, NUM_SLOTS)

    def draw(self, ids: Tensor, count: Tensor, step_dt: float) -> Draws | None:
        """Draw what is redrawn at each reset for some environments, ``count`` being their episode numbers; (n,) each.

        None where nothing is randomized. Nothing changes before :meth:`put`.
        """
        cfg = self.cfg
        if not cfg.enabled:
            return None
        strength, friction, motor_offset, latency, stiffness, damping = self._draw(
            self.reset_keys,
            ids,
            count,
            (cfg.strength_scale, NUM_SLOTS),
            (cfg.friction, 1),
            (cfg.motor_offset, NUM_SLOTS),
            (cfg.sensing_latency_s, 1),
            (cfg.stiffness_scale, NUM_SLOTS),
            (cfg.damping_scale, NUM_SLOTS),
        )
        offset = motor_offset * self.robots.slot_mask[ids]
        return Draws(friction.squeeze(1), offset, latency / step_dt, strength * stiffness, strength * damping)

    def put(self, ids: Tensor, draws: Draws) -> None:
        """Let what was drawn for some environments, shape (n,), be in force."""
        self.friction[ids], self.motor_offset[ids] = draws.friction, draws.motor_offset
        self.latency[ids] = draws.latency
        self._stiffness_scale[ids], self._damping_scale[ids] = draws.stiffness_scale, draws.damping_scale
        self._pool.set_friction(ids, draws.friction)
        self._pool.scale_gains(ids, draws.stiffness_scale, draws.damping_scale)

    def initial_state(self, ids: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draw initial states: root (n, 13), canonical joint positions [rad] and velocities [rad/s] (n, 32)."""
        robots = self.robots.rows(ids)
        root = robots.total_mass.new_zeros(len(ids), 13)
        root[:, 2] = robots.nominal_height + SPAWN_CLEARANCE * self.cfg.enabled
        root[:, 3] = 1.0
        if not self.cfg.enabled:
            return root, robots.default_joint_pos, torch.zeros_like(robots.default_joint_pos)
        root[:, 0:2], yaw, root[:, 7:13], scale, joint_vel = self._draw(
            self.start_keys,
            ids,
            count,
            ((-1.0, 1.0), 2),
            ((-np.pi, np.pi), 1),
            (self.cfg.init_root_vel, 6),
            (self.cfg.init_joint_scale, NUM_SLOTS),
            (self.cfg.init_joint_vel, NUM_SLOTS),
        )
        root[:, 3:7] = quat_from_yaw(yaw.squeeze(1))
        joint_pos = (robots.default_joint_pos * scale).clamp(robots.joint_soft_lower, robots.joint_soft_upper)
        return root, joint_pos, joint_vel * robots.slot_mask

    def _draw(self, stream: Tensor, ids: Tensor, count: Tensor, *rows: tuple[Range, int]) -> list[Tensor]:
        """Draw several quantities from one stream, each from its range and so many wide, shapes (n, width)."""
        widths = [width for _, width in rows]
        numbers = self._rng.uniform(stream, count, sum(widths), ids).to(self.friction.dtype)
        return [low + (high - low) * u for ((low, high), _), u in zip(rows, numbers.split(widths, dim=1), strict=True)]

    def pushes_at(self, step: Step, step_dt: float) -> Step | bool:
        """Whether the environments are pushed at the start of a control step; a tensor if ``step`` is one."""
        interval = round(self.cfg.push_interval_s / step_dt)
        return self.cfg.enabled and interval > 0 and step % interval == interval - 1

    def push(self, step: int, penalty_scale: float, step_dt: float) -> None:
        """Push every environment when its time has come; ``step`` counts the control steps since creation."""
        if not self.pushes_at(step, step_dt):
            return
        u = penalty_scale * self._rng.uniform_in(-1.0, 1.0, "push", step, 6)
        everyone = torch.arange(len(u), device=u.device)
        self._pool.push(everyone, u[:, :3] * self.cfg.push_lin_vel, u[:, 3:] * self.cfg.push_ang_vel)

    def state_dict(self) -> dict[str, Any]:
        """The draws in force; those made at creation follow from the seed."""
        names = ("friction", "motor_offset", "latency", "_stiffness_scale", "_damping_scale")
        return {name: getattr(self, name).clone() for name in names}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the draws and apply them to the physics."""
        for name, value in state.items():
            getattr(self, name).copy_(value)
        if self.cfg.enabled:
            everyone = torch.arange(len(self.friction), device=self.friction.device)
            self._pool.set_friction(everyone, self.friction)
            self._pool.scale_gains(everyone, self._stiffness_scale, self._damping_scale)
