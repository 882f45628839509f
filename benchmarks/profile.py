"""Where an iteration's time goes: ``eagle bench profile``."""

from __future__ import annotations

import torch
from rsl_rl.algorithms import ppo
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage

import eagle_rl.runners.on_policy as on_policy
from eagle_rl.algorithms.auxiliary import AuxiliaryLosses
from eagle_rl.algorithms.eagle_ppo import EaglePPO
from eagle_rl.models import EagleActor
from eagle_rl.runners.training_log import TrainingLog
from envs.humanoid_env import HumanoidEnv
from envs.sim.batch import RobotBatch
from envs.sim.pool import PhysicsPool

from .budget import Budget
from .measure import Figure
from .workloads import experiment, make_env, make_runner

SECTIONS: tuple[tuple[object, str, str, bool], ...] = (
    (RobotBatch, "advance", "physics", False),
    (PhysicsPool, "step", "state gather", False),
    (HumanoidEnv, "step", "MDP", False),
    (EaglePPO, "act", "inference", True),
    (RolloutStorage, "add_transition", "storage", True),
    (EaglePPO, "process_env_step", "storage", True),
    (EaglePPO, "compute_returns", "storage", True),
    (EaglePPO, "update", "minibatches and losses", False),
    (AuxiliaryLosses, "compute_loss", "forward", True),
    (EagleActor, "forward", "forward", False),
    (MLPModel, "forward", "forward", False),
    (torch.Tensor, "backward", "backward", False),
    (EaglePPO, "reduce_parameters", "optimiser", False),
    (ppo.nn.utils, "clip_grad_norm_", "optimiser", False),
    (torch.optim.Adam, "zero_grad", "optimiser", False),
    (torch.optim.Adam, "step", "optimiser", False),
    (on_policy, "require_sound", "logging", False),
    (TrainingLog, "add_step", "logging", False),
    (TrainingLog, "collect", "logging", False),
    (TrainingLog, "write", "logging", False),
)
"""Whose time is booked where, and whether the time of methods further in is booked there too."""


def profile(num_envs: int, threads: int, iterations: int = 5) -> list[Figure]:
    """Share of each section in the wall time of an iteration, and of what no thread worked in.

    ``idle`` is the part of ``threads`` cores that was not used, whatever the reason.
    """
    cfg = experiment(threads)
    runner = make_runner(cfg, make_env(cfg, num_envs))
    runner.learn(1)
    budget = Budget()
    for section in SECTIONS:
        budget.watch(*section)
    with budget:
        runner.learn(iterations)
    total = sum(budget.wall.values())
    used = sum(budget.cpu.values()) / (total * threads)
    steps = iterations * cfg.algo.num_steps_per_env * num_envs
    rows = [
        Figure(name, wall / total, "share", "", f"{1e3 * wall / iterations:.0f} ms, {1e6 * wall / steps:.1f} us a step")
        for name, wall in sorted(budget.wall.items(), key=lambda item: -item[1])
    ]
    idle = Figure("idle", max(0.0, 1.0 - used), "share", "", f"of {threads} cores")
    return [*rows, idle]
