"""What is measured: the environment as it trains, its physics alone, and the learner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from eagle_rl.cli.environment import make_env_factory
from eagle_rl.config.load import load_experiment
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.machine import own_cores
from eagle_rl.models.precision import set_up_torch
from eagle_rl.runners.on_policy import EagleRunner, make_train_cfg
from envs.humanoid_env import HumanoidEnv

SEED = 1


def experiment(threads: int) -> ExperimentCfg:
    """The default experiment with a number of physics threads; the learner has every core, as by default."""
    cfg = load_experiment("ppo")
    set_up_torch(own_cores())
    return replace(cfg, run=replace(cfg.run, num_threads=threads))


def make_env(
    cfg: ExperimentCfg, num_envs: int, robots: Sequence[str] | None = None, compiled: bool = True
) -> HumanoidEnv:
    """An environment in the middle of training: everything randomized, episodes of all ages, steps compiled."""
    env: HumanoidEnv = make_env_factory(cfg.run)(robots or cfg.robots, num_envs, cfg.task, SEED)
    torch.manual_seed(SEED)
    env.episode_length_buf = torch.randint(0, env.max_episode_length, (num_envs,))
    if compiled:
        env.compile()
    return env


class Stepping:
    """An environment under small random actions, so that its robots stand in their harness and few fall."""

    def __init__(self, env: HumanoidEnv) -> None:
        """Step until the first falls are over."""
        self.env = env
        with torch.inference_mode():
            for _ in range(25):
                self.step()

    def step(self) -> None:
        """One control step, with everything that belongs to it."""
        with torch.inference_mode():
            self.env.step(0.3 * torch.randn(self.env.num_envs, self.env.num_actions))


class BarePhysics:
    """The physics of an environment without anything around it: native threads over the same simulations.

    It goes on from the present states under the present targets, as the environment then does in its turn. MuJoCo's
    batch is as fast as a loop of ``mj_step`` in C (``docs/performance.md``).
    """

    def __init__(self, env: HumanoidEnv) -> None:
        """Take the simulations of ``env``."""
        self._batches = env.pool.batches

    def step(self) -> None:
        """As many physics steps as one control step has."""
        for batch in self._batches:
            batch.advance()


def make_runner(cfg: ExperimentCfg, env: HumanoidEnv) -> EagleRunner:
    """A learner that writes nothing."""
    history = cfg.task.observations.history_length
    return EagleRunner(env, make_train_cfg(cfg.algo, cfg.run, history_length=history, seed=SEED))
