"""What is commanded during an evaluation, and in which version of the task.

The commands of an environment depend only on (seed, robot, environment index): neither the number of environments nor
how they are batched moves anybody's commands. They are uniform on the finishing ranges and are *not* zeroed inside the
training dead zone, so that the errors of a robot that ignores its command have closed forms.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from eagle_rl.config.schema import CommandsCfg, EvaluationCfg, Range, TaskCfg, TerrainCfg

COMMANDS = ("lin_vel_x", "lin_vel_y", "ang_vel_z", "base_height", "body_pitch")
"""Names of the five commands in their order in every (..., 5) tensor."""
NUM_VELOCITIES = 3
"""The first three are velocities, all zero where a robot is to stand; the others are postures."""


def finishing_ranges(commands: CommandsCfg) -> tuple[Range, ...]:
    """What the five commands are drawn from, in their order."""
    return tuple(getattr(commands, name).finishing for name in COMMANDS)


def step_dt(task: TaskCfg) -> float:
    """Duration of one control step [s]."""
    return task.sim.physics_dt * task.sim.decimation


def evaluation_task(task: TaskCfg, ev: EvaluationCfg) -> TaskCfg:
    """The task a policy is judged in: flat ground, no curriculum, no aids, no time-out before the last step.

    Sensor noise and randomized dynamics are off unless ``ev`` asks for them; pushes are then at full strength.
    """
    seconds = (ev.num_steps + 1) * ev.physics_dt * ev.decimation
    return replace(
        task,
        sim=replace(task.sim, physics_dt=ev.physics_dt, decimation=ev.decimation),
        terrain=TerrainCfg(),
        commands=replace(task.commands, curriculum=replace(task.commands.curriculum, enabled=False)),
        observations=replace(task.observations, enable_corruption=ev.noise),
        rewards=replace(task.rewards, penalty_initial=1.0),
        terminations=replace(task.terminations, episode_length_s=seconds),
        randomization=replace(task.randomization, enabled=ev.randomization),
        aids=replace(task.aids, harness=0.0, gait_shaping=0.0),
    )


def steps_per_draw(ev: EvaluationCfg) -> int:
    """Control steps for which a command stays the same."""
    if ev.resampling_time_s <= 0.0:
        return ev.num_steps
    return max(1, round(ev.resampling_time_s / (ev.physics_dt * ev.decimation)))


def num_draws(ev: EvaluationCfg) -> int:
    """Commands an environment is given in turn."""
    return math.ceil(ev.num_steps / steps_per_draw(ev))


def judged_commands(ev: EvaluationCfg, num_envs: int) -> Tensor:
    """Which errors of each environment count, bool, shape (num_envs, 5).

    ``single`` judges environment i on the dimension i mod 5, the others judge all five; while a robot stands, its
    errors of velocity are the speed at which it drifts, and while it is upright those of posture are how it sags.
    """
    if ev.protocol == "single":
        return torch.arange(num_envs).unsqueeze(1) % len(COMMANDS) == torch.arange(len(COMMANDS))
    return torch.ones(num_envs, len(COMMANDS), dtype=torch.bool)


def drawn_commands(ev: EvaluationCfg, num_envs: int) -> Tensor:
    """Which commands are not zero, by draw, bool, shape (num_envs, draws, 5).

    ``upright`` keeps the postures at zero, ``standing`` the velocities; with redraws, in every second draw, so that at
    any time half of the environments walk, and all of them stop and start.
    """
    drawn = judged_commands(ev, num_envs).unsqueeze(1).repeat(1, num_draws(ev), 1)
    if ev.protocol == "upright":
        drawn[..., NUM_VELOCITIES:] = False
    if ev.protocol == "standing":
        turn = torch.arange(num_envs).unsqueeze(1) + torch.arange(num_draws(ev))
        drawn[..., :NUM_VELOCITIES] = ((turn % 2 == 1) & (num_draws(ev) > 1)).unsqueeze(2)
    return drawn


def draw_commands(commands: CommandsCfg, ev: EvaluationCfg, robot: str, num_envs: int) -> Tensor:
    """Commands of one robot's environments, shape (num_envs, draws, 5), float64.

    One draw lasts ``steps_per_draw`` control steps; see ``drawn_commands`` for which are zero.
    """
    generator = np.random.default_rng([ev.seed, zlib.crc32(robot.encode())])
    unit = torch.from_numpy(generator.random((num_envs, num_draws(ev), len(COMMANDS))))
    low, high = torch.tensor(finishing_ranges(commands), dtype=torch.float64).T
    return (low + (high - low) * unit) * drawn_commands(ev, num_envs)
