"""Small environments of the real robots, and the actions that drive them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.config.schema import AidsCfg, ObservationsCfg, RandomizationCfg, TaskCfg
from envs.humanoid_env import HumanoidEnv
from envs.robots.load import load_robot
from envs.robots.slots import NUM_SLOTS
from envs.robots.spec import RobotSpec

BARE = TaskCfg(
    randomization=RandomizationCfg(enabled=False),
    observations=ObservationsCfg(enable_corruption=False),
    aids=AidsCfg(harness=0.0, gait_shaping=0.0),
)
"""Nothing random but commands, no help."""


LOG_INTERVAL = TaskCfg().aids.interval_steps
"""Control steps between entries in ``extras["log"]``."""


@cache
def robot(name: str) -> RobotSpec:
    return load_robot(name)


def make_env(
    names: Sequence[str] = ("h1", "g1"),
    num_envs: int = 4,
    task: TaskCfg | None = None,
    seed: int = 3,
    dtype: torch.dtype = torch.float32,
    threads: int = 1,
) -> HumanoidEnv:
    return HumanoidEnv(
        task or TaskCfg(), [robot(name) for name in names], num_envs, seed, num_threads=threads, dtype=dtype
    )


def with_randomization(**rows: Any) -> TaskCfg:
    """The bare task with only these rows of the randomization table on."""
    off: dict[str, Any] = {
        "friction": (1.0, 1.0),
        "stiffness_scale": (1.0, 1.0),
        "damping_scale": (1.0, 1.0),
        "strength_scale": (1.0, 1.0),
        "motor_offset": (0.0, 0.0),
        "sensing_latency_s": (0.0, 0.0),
        "link_mass_scale": (1.0, 1.0),
        "link_com_offset": (0.0, 0.0),
        "base_mass_ratio": (0.0, 0.0),
        "base_com_offset": (0.0, 0.0),
        "push_lin_vel": 0.0,
        "push_ang_vel": 0.0,
        "init_joint_scale": (1.0, 1.0),
        "init_joint_vel": (0.0, 0.0),
        "init_root_vel": (0.0, 0.0),
    }
    return replace(BARE, randomization=RandomizationCfg(**(off | rows)))


def actions(num_envs: int, step: int, scale: float = 0.3) -> Tensor:
    """Reproducible actions of one step, shape (N, 32): the same row whatever the number of environments."""
    rows = [
        torch.randn(NUM_SLOTS, generator=torch.Generator().manual_seed(1000 * step + row)) for row in range(num_envs)
    ]
    return scale * torch.stack(rows)


def rollout(env: HumanoidEnv, steps: int, first: int = 0, scale: float = 0.3) -> Iterator[tuple[TensorDict, Tensor]]:
    """Observations and rewards of some steps under :func:`actions`."""
    for step in range(first, first + steps):
        observations, rewards, _, _ = env.step(actions(env.num_envs, step, scale))
        yield observations, rewards


def assert_same(first: TensorDict, second: TensorDict, what: str, rows: slice | Tensor = slice(None)) -> None:
    """Bitwise equality of every group, on some rows; the message names the group."""
    assert set(first.keys()) == set(second.keys())
    for name in first.keys():  # noqa: SIM118
        assert torch.equal(first[name][rows], second[name][rows]), f"group {name!r} differs: {what}"
