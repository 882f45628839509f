"""Random pooled states and robots for tests of the pure functions, in float64."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from eagle_rl.config.schema import ObservationsCfg
from envs.mdp.layout import ObservationLayout
from envs.mdp.symmetry import mirror_robots
from envs.robots.slots import MIRROR_PERMUTATION, NUM_SLOTS
from envs.state import PooledRobots, PooledState

NUM_SCAN_POINTS = ObservationLayout(ObservationsCfg()).num_scan_points


def random_robots(seed: int, num_envs: int = 8, num_robots: int = 2, symmetric: bool = False) -> PooledRobots:
    """Robots with some joints missing; ``symmetric`` ones equal their mirror image."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    mask = (uniform(num_envs, NUM_SLOTS) > 0.25).double()
    mask = mask * mask[:, MIRROR_PERMUTATION.tolist()]
    default = uniform(num_envs, NUM_SLOTS, low=-0.5, high=0.5) * mask
    robots = PooledRobots(
        robot_id=torch.arange(num_envs) % num_robots,
        slot_mask=mask,
        default_joint_pos=default,
        joint_soft_lower=(default - uniform(num_envs, NUM_SLOTS, low=0.2)) * mask,
        joint_soft_upper=(default + uniform(num_envs, NUM_SLOTS, low=0.2)) * mask,
        action_scale=uniform(num_envs, NUM_SLOTS, low=0.1, high=0.25) * mask,
        nominal_height=uniform(num_envs, low=0.5),
        swing_height=uniform(num_envs, low=0.08, high=0.15),
        total_mass=uniform(num_envs, low=30.0, high=60.0),
        gait_frequency=uniform(num_envs, low=1.5, high=2.5),
    )
    return _symmetrised(robots) if symmetric else robots


def _symmetrised(robots: PooledRobots) -> PooledRobots:
    mirrored = mirror_robots(robots)
    names = ("default_joint_pos", "joint_soft_lower", "joint_soft_upper", "action_scale")
    return replace(robots, **{name: 0.5 * (getattr(robots, name) + getattr(mirrored, name)) for name in names})


def random_state(seed: int, robots: PooledRobots, num_scan_points: int = NUM_SCAN_POINTS) -> PooledState:
    """A state with every quantity at random, zero in absent slots, consistent gravity and orientation not implied."""
    generator = torch.Generator().manual_seed(seed)
    n = len(robots.robot_id)

    def normal(*shape: int, scale: float = 1.0) -> Tensor:
        return scale * torch.randn(n, *shape, generator=generator, dtype=torch.float64)

    def slots(scale: float = 1.0) -> Tensor:
        return normal(NUM_SLOTS, scale=scale) * robots.slot_mask

    gravity = torch.cat((normal(2, scale=0.3), -torch.ones(n, 1, dtype=torch.float64)), dim=1)
    return PooledState(
        root_pos_w=normal(3),
        root_quat_w=torch.nn.functional.normalize(normal(4), dim=1),
        base_lin_vel_b=normal(3),
        base_ang_vel_b=normal(3),
        projected_gravity_b=torch.nn.functional.normalize(gravity, dim=1),
        base_height=robots.nominal_height + normal(scale=0.1),
        joint_pos=robots.default_joint_pos + slots(0.5),
        joint_vel=slots(3.0),
        joint_acc=slots(50.0),
        joint_torque=slots(30.0),
        foot_pos_w=normal(2, 3),
        foot_vel_w=normal(2, 3),
        foot_force_w=normal(2, 3, scale=30.0),
        foot_height=normal(2, scale=0.05).abs(),
        last_foot_contact=normal(2) > 0.0,
        link_force_w=normal(7, 3, scale=2.0),
        ground_contact=normal() > 0.0,
        height_scan=normal(num_scan_points, scale=0.02),
        friction=torch.rand(n, generator=generator, dtype=torch.float64) + 0.5,
        command=normal(5, scale=0.5),
        standing=normal() > 1.0,
        foot_phase=torch.rand(n, 2, generator=generator, dtype=torch.float64),
        actions=slots(),
        last_actions=slots(),
        last_last_actions=slots(),
    )


def quiet_state(robots: PooledRobots) -> PooledState:
    """Standing perfectly still and upright in the default pose, at a zero command, in mid-stance."""
    zeros = {
        name: torch.zeros_like(value) for name, value in vars(random_state(0, robots)).items() if name != "root_quat_w"
    }
    quat = torch.zeros(len(robots.robot_id), 4, dtype=torch.float64)
    quat[:, 0] = 1.0
    gravity = torch.zeros(len(robots.robot_id), 3, dtype=torch.float64)
    gravity[:, 2] = -1.0
    state = PooledState(root_quat_w=quat, **zeros)
    return replace(
        state,
        projected_gravity_b=gravity,
        base_height=robots.nominal_height.clone(),
        joint_pos=robots.default_joint_pos.clone(),
        foot_phase=torch.full_like(state.foot_phase, 0.25),
        standing=torch.ones_like(state.standing),
    )


def quaternion(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Tensor:
    """(w, x, y, z) of roll, then pitch, then yaw about the world's axes, shape (4,)."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    return torch.tensor(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        dtype=torch.float64,
    )
