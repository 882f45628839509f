"""Shares of the pool and the per-environment constants of each robot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from eagle_rl.config.schema import ControlCfg, GaitCfg, TaskCfg
from eagle_rl.errors import ConfigError

from .robots.posture import leg_length
from .robots.slots import HIP_YAW_SLOTS, LEG_PITCH_SLOTS, NUM_SLOTS, SHOULDER_PITCH_SLOTS, UPPER_SLOTS, WAIST_SLOTS
from .robots.spec import Array, RobotSpec
from .state import PooledRobots

REFERENCE_LEG = 0.87
"""Leg of H1 [m], whose gait frequency the configuration gives."""


def share(num_envs: int, num_robots: int) -> list[int]:
    """Equal shares of the pool; a remainder is spread over the first robots (paper, "equal probability").

    Raises:
        ConfigError: fewer environments than robots.
    """
    if num_envs < num_robots:
        raise ConfigError(f"num_envs: got {num_envs}, expected at least one for each of {num_robots} robots.")
    base, extra = divmod(num_envs, num_robots)
    return [base + (robot < extra) for robot in range(num_robots)]


def action_scale(spec: RobotSpec, cfg: ControlCfg) -> Array:
    """Radians of PD target per unit action in slots, zero where the robot has no joint, shape (32,).

    ``action_scale * clip(effort / kp, bound, 1)``: one unit never asks a weak, stiff joint for much more than it has.
    """
    slots = np.arange(NUM_SLOTS)
    bound = np.where(np.isin(slots, LEG_PITCH_SLOTS), cfg.min_effort_ratio_leg_pitch, cfg.min_effort_ratio)
    bound = np.where(np.isin(slots, SHOULDER_PITCH_SLOTS), cfg.min_effort_ratio_shoulder_pitch, bound)
    extra = np.where(np.isin(slots, HIP_YAW_SLOTS), cfg.hip_yaw_ratio, 1.0)
    extra = np.where(np.isin(slots, UPPER_SLOTS), cfg.upper_ratio, extra)
    extra = np.where(np.isin(slots, WAIST_SLOTS), cfg.waist_ratio, extra)
    ratio = np.clip(spec.effort_limit / spec.stiffness, bound[spec.slots], 1.0)
    return cfg.action_scale * extra * spec.to_slots(ratio)


def gait_frequency(spec: RobotSpec, cfg: GaitCfg) -> float:
    """Steps of one foot per second [Hz]; see ``GaitCfg.leg_scaling``."""
    return float(cfg.frequency * (REFERENCE_LEG / leg_length(spec)) ** cfg.leg_scaling)


def soft_limits(spec: RobotSpec, ratio: float) -> tuple[Array, Array]:
    """Canonical limits shrunk about their middle by ``ratio`` [rad], shape (32,) each."""
    ends = spec.signs * np.stack([spec.joint_lower - spec.zero_offsets, spec.joint_upper - spec.zero_offsets])
    lower, upper = ends.min(axis=0), ends.max(axis=0)
    middle, half = 0.5 * (lower + upper), 0.5 * ratio * (upper - lower)
    return spec.to_slots(middle - half), spec.to_slots(middle + half)


def pool_robots(
    specs: Sequence[RobotSpec],
    counts: Sequence[int],
    task: TaskCfg,
    device: torch.device,
    dtype: torch.dtype,
) -> PooledRobots:
    """Repeat each robot's constants over its environments."""
    limits = [soft_limits(spec, task.rewards.soft_limit_ratio) for spec in specs]

    def repeat(values: Sequence[Array | float]) -> Tensor:
        rows = torch.as_tensor(np.stack([np.asarray(value, dtype=np.float64) for value in values]))
        return torch.repeat_interleave(rows, torch.tensor(counts), dim=0).to(device=device, dtype=dtype)

    return PooledRobots(
        robot_id=torch.repeat_interleave(torch.arange(len(specs)), torch.tensor(counts)).to(device),
        slot_mask=repeat([spec.slot_mask.astype(np.float64) for spec in specs]),
        default_joint_pos=repeat([spec.to_canonical(spec.default_joint_pos) for spec in specs]),
        joint_soft_lower=repeat([lower for lower, _ in limits]),
        joint_soft_upper=repeat([upper for _, upper in limits]),
        action_scale=repeat([action_scale(spec, task.control) for spec in specs]),
        nominal_height=repeat([spec.nominal_height for spec in specs]),
        swing_height=repeat([spec.swing_height for spec in specs]),
        total_mass=repeat([spec.total_mass for spec in specs]),
        gait_frequency=repeat([gait_frequency(spec, task.gait) for spec in specs]),
    )
