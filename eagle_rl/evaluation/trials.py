"""Pairs of trials that differ in nothing but the policy: same world, same start, commands and random numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.config.schema import EvaluationCfg, ExperimentCfg, TaskCfg
from eagle_rl.evaluation.evaluate import MakeEnv
from eagle_rl.evaluation.protocol import (
    NUM_VELOCITIES,
    draw_commands,
    evaluation_task,
    finishing_ranges,
    steps_per_draw,
)

Act = Callable[[TensorDict], Tensor]
"""Actions (P, 32) for observations (P,)."""


class PairedTrials:
    """Two lots of P environments of one robot, compared from one state, some of them randomized as in training."""

    def __init__(self, cfg: ExperimentCfg, make_env: MakeEnv, seed: int) -> None:
        """Build both lots from ``cfg.search`` and the one robot of ``cfg``, in the physics of training."""
        search = cfg.search
        self._cfg, self._robot, self._seed = search, cfg.robots[0], seed
        disturbed = round(search.randomized_share * search.num_pairs)
        worlds = [(search.num_pairs - disturbed, False), (disturbed, True)]
        worlds = [(size, randomized) for size, randomized in worlds if size]
        self._sizes = [size for size, _ in worlds]
        self._ev, task = _world(cfg, randomized=False)
        self._ranges, self._device = task.commands, cfg.run.env_device
        self._lots: tuple[list[Any], ...] = tuple(
            [make_env(cfg.robots, size, _world(cfg, randomized)[1], seed) for size, randomized in worlds]
            for _ in range(2)
        )
        worst = [max(map(abs, bounds)) for bounds in finishing_ranges(task.commands)]
        self._fallen_errors = torch.tensor(worst, device=self._device)
        self._units = torch.tensor(search.error_units, device=self._device)

    @property
    def steps(self) -> int:
        """Environment steps of one lot's trial."""
        return self._cfg.num_pairs * self._cfg.num_steps

    def observations(self, lot: int = 0) -> TensorDict:
        """What a lot sees at the moment."""
        return _joined([env.get_observations() for env in self._lots[lot]])

    @property
    def mirror(self) -> Mapping[str, tuple[Tensor, Tensor]]:
        """Permutation and signs of every observation group and of ``actions``."""
        mirror: Mapping[str, tuple[Tensor, Tensor]] = self._lots[0][0].mirror
        return mirror

    def mirrored(self, obs: TensorDict) -> TensorDict:
        """What the mirror images of the robots would see, in the groups that have sides."""
        sided = {name: pair for name, pair in self.mirror.items() if name in obs.keys()}  # noqa: SIM118
        return obs.clone(recurse=False).update(
            {name: obs[name].index_select(1, perm) * sign for name, (perm, sign) in sided.items()}
        )

    def commands(self, number: int) -> Tensor:
        """Commands of the trials of this number, some of them to stand, shape (P, draws, 5)."""
        seed = self._seed + number
        ev = dataclasses.replace(self._ev, seed=seed)
        commands = draw_commands(self._ranges, ev, self._robot, self._cfg.num_pairs)
        chance = torch.rand(commands.shape[:2], generator=torch.Generator().manual_seed(seed))
        stands = chance < self._cfg.standing_probability
        commands[..., :NUM_VELOCITIES] *= ~stands.unsqueeze(2)
        return commands.float().to(self._device)

    def compare(self, commands: Tensor, acts: tuple[Act, Act]) -> tuple[Tensor, Tensor]:
        """Let both lots follow the same commands from the same state, each with policies of its own.

        Whoever falls starts again and draws a world of its own; without the state of the first lot, robots that fell in
        one lot alone would be in two worlds ever after.

        Args:
            commands: shape (P, draws, 5).
            acts: the policies of each lot.

        Returns:
            What :meth:`follow` returns of both lots, (2, P) each.
        """
        first = self.state_dict()[0]
        self.load_state_dict([first, first])
        cost, fell = zip(*(self.follow(lot, commands, act) for lot, act in enumerate(acts)), strict=True)
        return torch.stack(cost), torch.stack(fell)

    def follow(self, lot: int, commands: Tensor, act: Act) -> tuple[Tensor, Tensor]:
        """Let one lot follow commands from rest.

        Args:
            lot: 0 or 1.
            commands: shape (P, draws, 5).
            act: the policies.

        Returns:
            Mean error over steps and commands in multiples of ``error_units``, (P,), in which every step after a fall
            counts as the largest command there is; and who fell, bool (P,).
        """
        envs, redraw = self._lots[lot], steps_per_draw(self._ev)
        self._pin(lot, commands[:, 0])
        for env in envs:
            env.reset()
        fell = torch.zeros(len(commands), dtype=torch.bool, device=self._device)
        cost = torch.zeros(len(commands), device=self._device)
        for t in range(self._cfg.num_steps):
            if t % redraw == 0:
                self._pin(lot, commands[:, t // redraw])
                obs = self.observations(lot)
            steps = [env.step(actions) for env, actions in zip(envs, act(obs).split(self._sizes), strict=True)]
            obs = _joined([step[0] for step in steps])
            fell |= torch.cat([dones.bool() & ~extras["time_outs"].bool() for _, _, dones, extras in steps])
            followed = torch.cat([env.tracking_errors().float() for env in envs])
            errors = torch.where(fell.unsqueeze(1), self._fallen_errors, followed)
            if t >= self._cfg.settling_steps:
                cost += (errors / self._units).mean(dim=1)
        return cost / (self._cfg.num_steps - self._cfg.settling_steps), fell

    def _pin(self, lot: int, commands: Tensor) -> None:
        """Give each environment of a lot its command, (P, 5)."""
        for env, part in zip(self._lots[lot], commands.split(self._sizes), strict=True):
            env.pin_commands(part)

    def state_dict(self) -> list[list[dict[str, Any]]]:
        """State of both lots."""
        return [[env.state_dict() for env in lot] for lot in self._lots]

    def load_state_dict(self, state: list[list[dict[str, Any]]]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for lot, saved in zip(self._lots, state, strict=True):
            for env, part in zip(lot, saved, strict=True):
                env.load_state_dict(part)


def _joined(parts: list[TensorDict]) -> TensorDict:
    joined: object = torch.cat(parts)  # type: ignore[arg-type]
    assert isinstance(joined, TensorDict)
    return joined


def _world(cfg: ExperimentCfg, randomized: bool) -> tuple[EvaluationCfg, TaskCfg]:
    """How commands are drawn, and the task of the trials in the nominal or the randomized world."""
    search, sim = cfg.search, cfg.task.sim
    ev = EvaluationCfg(
        num_steps=search.num_steps,
        resampling_time_s=search.resampling_time_s,
        physics_dt=sim.physics_dt,
        decimation=sim.decimation,
        randomization=randomized,
        noise=randomized,
    )
    return ev, evaluation_task(cfg.task, ev)
