"""How learner and simulation meet: robots by name become one pooled environment."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from eagle_rl.config.schema import RunCfg, TaskCfg
from eagle_rl.machine import own_cores

if TYPE_CHECKING:
    from rsl_rl.env import VecEnv

    from eagle_rl.evaluation.evaluate import MakeEnv


def make_env_factory(run: RunCfg) -> MakeEnv:
    """The function by which runners build environments without knowing the simulation; it can be pickled.

    Args:
        run: device of the environments' tensors and number of physics threads.
    """
    return partial(_make_env, run)


def _make_env(
    run: RunCfg, robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first_env: int = 0
) -> VecEnv:
    from envs.humanoid_env import HumanoidEnv
    from envs.robots.load import load_robot

    specs = [load_robot(name) for name in robots]
    threads = run.num_threads or own_cores()
    return HumanoidEnv(task, specs, num_envs, seed, device=run.env_device, num_threads=threads, first_env=first_env)
