"""Run a policy through the protocol, robot by robot, in chunks of environments that bound the memory."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.config.schema import CommandsCfg, EvaluationCfg, Range, TaskCfg
from eagle_rl.errors import CheckpointError
from eagle_rl.evaluation.falls import BalancedEnv, Fall, FallWatch
from eagle_rl.evaluation.metrics import SETTLING_TIME_S, RobotMetrics, TrackingAccumulator
from eagle_rl.evaluation.protocol import (
    draw_commands,
    evaluation_task,
    finishing_ranges,
    judged_commands,
    step_dt,
    steps_per_draw,
)

FORMAT = 1
"""Version of the JSON an evaluation is stored as."""

_TILE = 128
"""Rows the policy sees at once. Matrix products of another height may round differently, and contacts amplify that;
so the policy always sees full tiles, and chunks are whole tiles."""

Policy = Callable[[TensorDict], Tensor]
"""Deterministic actions (N, 32) for observations (N,)."""


class TrackingEnv(BalancedEnv, Protocol):
    """What an evaluation needs of an environment."""

    num_envs: int

    def pin_commands(self, command: Tensor | None) -> None:
        """Command this, shape (N, 5), until told otherwise."""

    def get_observations(self) -> TensorDict:
        """Observations under the present command."""

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Advance one control step: observations, rewards, dones and extras with ``time_outs``."""

    def tracking_errors(self) -> Tensor:
        """Absolute errors at the present state, shape (N, 5); of who has just fallen, those of the new episode."""


class MakeEnv(Protocol):
    """Builds environments; ``first_env`` is the number each robot's first one goes by in the random streams."""

    def __call__(self, robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first_env: int = 0, /) -> Any:
        """So many environments over all these robots: a TrackingEnv to an evaluation, a VecEnv to a learner."""


@dataclass(frozen=True, kw_only=True)
class EvaluationResult:
    """Scores of one policy, with everything needed to repeat them."""

    checkpoint: str
    """sha256 of the checkpoint's content."""
    protocol: EvaluationCfg
    robots: Mapping[str, RobotMetrics]
    seed: int
    """Seed of the training run."""
    env_steps: int | None = None
    """Environment steps the policy has cost, if known."""
    unseen: tuple[str, ...] = ()
    """Robots the policy was not trained on."""
    ranges: tuple[Range, ...] = finishing_ranges(CommandsCfg())
    """What the commands were drawn from; earlier versions, which did not keep it, are taken to have had the default."""

    def to_json(self) -> str:
        """One JSON document."""
        return json.dumps({"format": FORMAT, **dataclasses.asdict(self)}, indent=1)

    @classmethod
    def from_json(cls, text: str) -> EvaluationResult:
        """Read back ``to_json``."""
        data = json.loads(text)
        if data.get("format") != FORMAT:
            raise CheckpointError(f"format {data.get('format')!r}, expected {FORMAT}: evaluate again")
        return cls(
            checkpoint=data["checkpoint"],
            protocol=EvaluationCfg(**data["protocol"]),
            robots={name: RobotMetrics.from_dict(robot) for name, robot in data["robots"].items()},
            seed=data["seed"],
            env_steps=data["env_steps"],
            unseen=tuple(data.get("unseen", ())),
            ranges=tuple(tuple(bounds) for bounds in data.get("ranges", cls.ranges)),
        )

    @classmethod
    def read(cls, path: Path) -> EvaluationResult:
        """Read a result file.

        Raises:
            CheckpointError: it is none.
        """
        try:
            return cls.from_json(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise CheckpointError(f"{path}: not a result of eagle evaluate: {error}.") from error


def evaluate(
    policy: Policy,
    make_env: MakeEnv,
    robots: Sequence[str],
    task: TaskCfg,
    ev: EvaluationCfg,
    chunk_envs: int = 512,
    on_step: Callable[[int], None] = lambda steps: None,
) -> dict[str, RobotMetrics]:
    """Score a policy on each robot.

    Args:
        policy: deterministic actions from observations.
        make_env: builds a TrackingEnv.
        robots: robots to judge.
        task: the task it was trained in; the protocol makes it an evaluation.
        ev: the protocol.
        chunk_envs: environments simulated together, rounded up to whole tiles; changes memory, not the result.
        on_step: told after every control step how many environment steps were made.
    """
    task = evaluation_task(task, ev)
    size = -(-chunk_envs // _TILE) * _TILE
    metrics = {}
    for robot in robots:
        commands = draw_commands(task.commands, ev, robot, ev.num_envs_per_robot)
        judged = judged_commands(ev, ev.num_envs_per_robot)
        parts: list[TrackingAccumulator] = []
        falls: list[Fall] = []
        for start in range(0, ev.num_envs_per_robot, size):
            chunk = commands[start : start + size]
            env = make_env([robot], len(chunk), task, ev.seed, start)
            accumulator = TrackingAccumulator(judged[start : start + size])
            falls += _run_chunk(policy, env, chunk, accumulator, task, ev, on_step)
            parts.append(accumulator)
        falls.sort(key=attrgetter("time_s"))  # however environments were simulated together
        metrics[robot] = dataclasses.replace(TrackingAccumulator.join(parts).finish(), falls=tuple(falls))
    return metrics


@torch.inference_mode()
def _run_chunk(
    policy: Policy,
    env: TrackingEnv,
    commands: Tensor,
    accumulator: TrackingAccumulator,
    task: TaskCfg,
    ev: EvaluationCfg,
    on_step: Callable[[int], None],
) -> list[Fall]:
    """Roll out one chunk of environments, whose errors are accumulated; commands have shape (N, draws, 5)."""
    watch = FallWatch(env, step_dt(task))
    draw_steps = steps_per_draw(ev)
    settling_steps = round(SETTLING_TIME_S / step_dt(task))
    for t in range(ev.num_steps):
        command = commands[:, t // draw_steps]
        settled = t % draw_steps >= settling_steps
        if not accumulator.alive.any():
            accumulator.add(torch.zeros_like(command), command, ~accumulator.alive, settled)
            continue
        if t % draw_steps == 0:
            env.pin_commands(command)
            obs = env.get_observations()
        watch.look()
        obs, _, dones, extras = env.step(tiled(policy, obs))
        fell = (dones.bool() & ~extras["time_outs"].bool()).cpu()
        watch.note(t, command, fell & accumulator.alive)
        accumulator.add(env.tracking_errors().cpu(), command, fell, settled)
        on_step(len(command))
    return watch.falls


def tiled(policy: Policy, obs: TensorDict) -> Tensor:
    """Actions of the policy, computed in tiles of equal height, the last one filled up with its own first row."""
    num_envs = len(obs)
    rows = torch.arange(-(-num_envs // _TILE) * _TILE, device=obs.device)
    rows = torch.where(rows < num_envs, rows, (rows // _TILE) * _TILE)
    return torch.cat([policy(obs[tile]) for tile in rows.split(_TILE)])[:num_envs]
