"""Robots of one kind that follow commands from rest by a corrected policy: what it costs, and what they saw."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.algorithms.correction import error_waves
from eagle_rl.algorithms.foresight import Trace
from eagle_rl.config.schema import EvaluationCfg, ExperimentCfg
from eagle_rl.evaluation.evaluate import MakeEnv
from eagle_rl.evaluation.protocol import COMMANDS, NUM_VELOCITIES, draw_commands, evaluation_task
from eagle_rl.models import EagleActor
from eagle_rl.models.correction import Correction


@dataclass(frozen=True)
class Rollout:
    """What came of M robots."""

    command: Tensor
    """As the policy saw it, shape (M, 5)."""
    waves: Tensor
    """Of the errors in multiples of their units, shape (M, 5, B)."""
    cost: Tensor
    """Mean error in multiples of the units, of who falls that of the largest commands there are, shape (M,)."""
    fell: Tensor
    """Bool, shape (M,)."""


@dataclass(frozen=True)
class _Step:
    """Of M robots."""

    before: TensorDict
    """What is kept of the observations the action was chosen by: history, phase and command."""
    phase: Tensor
    """Of the gait after it, shape (M,)."""
    error: Tensor
    """Signed, in multiples of the units, shape (M, 5)."""
    fell: Tensor
    """Bool, shape (M,)."""


class Followers:
    """Makes rollouts in the physics of evaluation: calm ones, or rough ones with its randomization and noise."""

    def __init__(self, cfg: ExperimentCfg, actor: EagleActor, make_env: MakeEnv, seed: int) -> None:
        """Let the first robot of ``cfg`` follow by ``actor``."""
        self.cfg, self._actor, self._make_env, self._seed = cfg, actor, make_env, seed
        fine = cfg.evaluation  # footfalls ring on otherwise at other steps, and so does what answers them
        self.calm = EvaluationCfg(
            num_steps=cfg.correction.num_steps, physics_dt=fine.physics_dt, decimation=fine.decimation
        )
        self.rough = replace(self.calm, randomization=True, noise=True)
        self._units = torch.tensor(cfg.search.error_units, device=cfg.run.env_device)
        self.limits = torch.tensor(
            [getattr(cfg.task.commands, name).finishing for name in COMMANDS], device=cfg.run.env_device
        )
        self.env_steps = 0

    def env(self, num_envs: int, ev: EvaluationCfg) -> Any:
        """Environments of a world, in the same state every time."""
        task = evaluation_task(self.cfg.task, ev)
        return self._make_env(self.cfg.robots, num_envs, task, self._seed)

    def generator(self, number: int) -> torch.Generator:
        """Random numbers that belong to a number."""
        return torch.Generator().manual_seed(self._seed + number)

    def follow(
        self,
        correction: Correction,
        number: int,
        change: Tensor | float = 0.0,
        gains: Tensor | float = 0.0,
        ev: EvaluationCfg | None = None,
    ) -> Rollout:
        """Let robots follow the commands of this number, in calm or by ``ev``, with something changed."""
        ev = ev or self.calm
        settling = self.cfg.correction.settling_steps
        errors, phases, falls = [], [], []
        for step in self._walk(number, ev, lambda obs: correction.act(self._actor, obs, change, gains)):
            errors.append(step.error)
            phases.append(step.phase)
            falls.append(step.fell)
        command = step.before["command"]
        late, fell = torch.stack(errors[settling:]), torch.stack(falls).any(dim=0)
        worst = (self.limits.abs().amax(dim=1) / self._units).mean()
        cost = torch.where(fell, worst, late.abs().mean(dim=(0, 2)))
        return Rollout(command, error_waves(late, torch.stack(phases[settling:])), cost, fell)

    def disturbed(self, correction: Correction, number: int, ev: EvaluationCfg) -> Trace:
        """What robots saw and did with noise of ``correction.foresight_std`` on every action, if they stayed up."""
        generator, std, changes = self.generator(number), self.cfg.correction.foresight_std, []

        def act(obs: TensorDict) -> Tensor:
            noise = std * torch.randn(len(obs["command"]), len(correction.slots), generator=generator)
            changes.append(noise.to(self._units))
            return correction.act(self._actor, obs, extra_actions=changes[-1])

        steps = list(self._walk(number, ev, act))
        stood = ~torch.stack([step.fell for step in steps]).any(dim=0)
        settling = self.cfg.correction.settling_steps
        later = steps[settling:]
        trace = Trace(
            history=torch.stack([step.before["history"] for step in later]),
            phase=torch.stack([step.before["phase"] for step in later]),
            command=correction.normalised(steps[0].before["command"]),
            change=torch.stack(changes[settling:]),
            error=torch.stack([step.error for step in later]),
        )
        return trace.of(stood)

    def _walk(self, number: int, ev: EvaluationCfg, act: Callable[[TensorDict], Tensor]) -> Iterator[_Step]:
        """Step robots from rest."""
        correcting = self.cfg.correction
        ev = replace(ev, seed=self._seed + number)
        drawn = draw_commands(self.cfg.task.commands, ev, self.cfg.robots[0], correcting.num_envs)
        commands = drawn[:, 0].to(self._units)
        commands[: round(correcting.upright_share * len(commands)), NUM_VELOCITIES:] = 0.0
        env = self.env(correcting.num_envs, ev)
        env.pin_commands(commands)
        obs = env.get_observations()
        for _ in range(correcting.num_steps):
            before = obs
            obs, _, dones, extras = env.step(act(before))
            self.env_steps += len(commands)
            yield _Step(
                before=before.select("history", "phase", "command"),
                phase=obs["phase"],
                error=(env.measured_commands().to(commands) - commands) / self._units,
                fell=dones.bool() & ~extras["time_outs"].bool(),
            )
