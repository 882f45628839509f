"""Robots of one kind that follow commands by a corrected policy: what it costs, and what they saw."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
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
    """What came of M robots, those that follow another command after theirs counted once more for it."""

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
        num_commands: int = 1,
    ) -> Rollout:
        """Let robots follow commands of this number from rest, in calm or by ``ev``, with something changed.

        Of ``num_commands`` one after the other, each is a rollout of its own.
        """
        ev = ev or self.calm
        walk = self._walk(number, ev, lambda obs: correction.act(self._actor, obs, change, gains), num_commands)
        steps = [replace(step, before=step.before.select("command")) for step in walk]  # histories would fill memory
        each = self.cfg.correction.num_steps
        rollouts = [self._rollout(steps[start : start + each]) for start in range(0, len(steps), each)]
        return Rollout(*(torch.cat([getattr(r, field.name) for r in rollouts]) for field in fields(Rollout)))

    def _rollout(self, steps: list[_Step]) -> Rollout:
        """What came of robots that followed one command."""
        late, fell = steps[self.cfg.correction.settling_steps :], torch.stack([step.fell for step in steps]).any(dim=0)
        errors = torch.stack([step.error for step in late])
        worst = (self.limits.abs().amax(dim=1) / self._units).mean()
        cost = torch.where(fell, worst, errors.abs().mean(dim=(0, 2)))
        waves = error_waves(errors, torch.stack([step.phase for step in late]))
        return Rollout(command=steps[0].before["command"], waves=waves, cost=cost, fell=fell)

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

    def _walk(
        self, number: int, ev: EvaluationCfg, act: Callable[[TensorDict], Tensor], num_commands: int = 1
    ) -> Iterator[_Step]:
        """Step robots from rest, ``correction.num_steps`` for every command, with no time-out in between."""
        env = self.env(self.cfg.correction.num_envs, replace(ev, num_steps=num_commands * ev.num_steps))
        for commands in self._commands(number, num_commands).unbind(dim=1):
            env.pin_commands(commands)
            obs = env.get_observations()
            for _ in range(self.cfg.correction.num_steps):
                before = obs
                obs, _, dones, extras = env.step(act(before))
                self.env_steps += len(commands)
                yield _Step(
                    before=before.select("history", "phase", "command"),
                    phase=obs["phase"],
                    error=(env.measured_commands().to(commands) - commands) / self._units,
                    fell=dones.bool() & ~extras["time_outs"].bool(),
                )

    def _commands(self, number: int, num_commands: int) -> Tensor:
        """Commands of this number, some of them upright, shape (M, num_commands, 5)."""
        correcting, ev = self.cfg.correction, self.calm
        ev = replace(
            ev,
            seed=self._seed + number,
            num_steps=num_commands * ev.num_steps,
            resampling_time_s=ev.num_steps * ev.physics_dt * ev.decimation,
        )
        commands = draw_commands(self.cfg.task.commands, ev, self.cfg.robots[0], correcting.num_envs).to(self._units)
        upright = round(correcting.upright_share * len(commands))
        for draw in range(num_commands):  # half of who was upright stays so
            rows = (torch.arange(upright) + draw * upright // 2) % len(commands)
            commands[rows, draw, NUM_VELOCITIES:] = 0.0
        return commands
