"""What is measured: the environment as it trains, its physics alone, and the learner."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from eagle_rl.cli.environment import make_env_factory
from eagle_rl.config.load import load_experiment
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.machine import own_cores
from eagle_rl.models.precision import set_up_torch
from eagle_rl.runners.on_policy import EagleRunner, make_train_cfg
from envs.humanoid_env import HumanoidEnv
from envs.robots.spec import Array
from envs.sim.batch import RobotBatch

from .measure import Cost, in_turns

SEED = 1
_ACTIONS = 32
"""Different actions under which an environment is stepped in turn."""


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
    env.stagger()
    if compiled:
        env.compile()
    return env


class Stepping:
    """An environment under small random actions, so that its robots stand in their harness and few fall."""

    def __init__(self, env: HumanoidEnv) -> None:
        """Step until the first falls are over."""
        self.env = env
        actions = 0.3 * torch.randn(_ACTIONS, env.num_envs, env.num_actions)  # drawn by a policy, not by the step
        self._actions = itertools.cycle(actions.unbind())
        with torch.inference_mode():
            for _ in range(25):
                self.step()

    def step(self) -> None:
        """One control step, with everything that belongs to it."""
        with torch.inference_mode():
            self.env.step(next(self._actions))


class BarePhysics:
    """The physics of an environment without anything around it: its threads over the same simulations.

    It takes the control steps that the environment took once more, from the same states under the same targets; under
    targets that stay as they are robots come to rest, and physics is up to a tenth quicker. MuJoCo's batch is as fast
    as a loop of ``mj_step`` in C (``docs/performance.md``).
    """

    def __init__(self, env: HumanoidEnv) -> None:
        """Take the simulations of ``env``."""
        self._batches, self._threads = env.pool.batches, env.pool.threads
        self._starts: list[list[tuple[Array, Array]]] = []
        self._present: list[Array] | None = None

    def remember(self) -> None:
        """Keep the states from which the environment takes its next step."""
        self._starts.append([(batch.state(), batch.ctrl) for batch in self._batches])

    def remember_targets(self) -> None:
        """Keep the targets under which it took that step."""
        self._starts[-1] = [(state, targets.copy()) for state, targets in self._starts[-1]]

    def rewind(self) -> None:
        """Go back to where the first of the remembered steps began, and forget it."""
        if self._present is None:
            self._present = [batch.state() for batch in self._batches]
        for batch, (state, targets) in zip(self._batches, self._starts.pop(0), strict=True):
            batch.overwrite(state)
            batch.ctrl[:] = targets

    def step(self) -> None:
        """As many physics steps as one control step has."""
        self._threads.share_out(RobotBatch.advance, self._batches)

    def return_to_present(self) -> None:
        """Undo what was rewound."""
        if self._present is not None:
            for batch, state in zip(self._batches, self._present, strict=True):
                batch.overwrite(state)
            self._present = None

    def begin(self) -> None:
        """Make ready for a step of the environment."""
        self.return_to_present()
        self.remember()

    def again(self) -> None:
        """Make ready for the same step by physics alone."""
        self.remember_targets()
        self.rewind()


@dataclass(frozen=True)
class StepCost:
    """What a step of an environment costs."""

    step: Cost
    """With everything that belongs to it."""
    bare: Cost
    """Its physics alone."""

    @property
    def overhead(self) -> float:
        """What comes on top of physics, CPU time [s]."""
        return max(0.0, self.step.cpu - self.bare.cpu)


def step_costs(envs: Mapping[str, HumanoidEnv], seconds: float) -> dict[str, StepCost]:
    """Costs of steps of several environments and of their bare physics, measured all in turn."""
    actions: dict[str, Callable[[], object]] = {}
    before: dict[str, Callable[[], object]] = {}
    for name, env in envs.items():
        bare = BarePhysics(env)
        actions |= {f"{name} step": Stepping(env).step, f"{name} bare": bare.step}
        before |= {f"{name} step": bare.begin, f"{name} bare": bare.again}
    costs = in_turns(actions, seconds, before=before)
    return {name: StepCost(costs[f"{name} step"], costs[f"{name} bare"]) for name in envs}


def make_runner(cfg: ExperimentCfg, env: HumanoidEnv) -> EagleRunner:
    """A learner that writes nothing."""
    history = cfg.task.observations.history_length
    return EagleRunner(env, make_train_cfg(cfg.algo, cfg.run, history_length=history, seed=SEED))
