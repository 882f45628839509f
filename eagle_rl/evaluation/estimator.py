"""How well does the policy know its own speed and body? Its estimator, judged on randomized robots it has not met."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from eagle_rl.config.schema import EvaluationCfg, RandomizationCfg, TaskCfg
from eagle_rl.errors import ConfigError
from eagle_rl.evaluation.evaluate import MakeEnv
from eagle_rl.evaluation.protocol import draw_commands, evaluation_task, step_dt, steps_per_draw
from eagle_rl.models import EagleActor

WARM_UP_S = 1.0
"""Time after the start before the first sample [s]."""
STRIDE_S = 0.2
"""Time between samples [s]."""
REDRAW_S = 4.0
"""Time between commands [s]."""
MIN_SPREAD = 0.1
"""Standard deviation of a target, in units of the estimate, under which there is nothing to explain [-].

A unit is what a channel varies by over the robots that o_ea is standardised with, and what the estimator's loss counts
in. A smaller spread costs who ignores it less than a hundredth of a channel's loss, and an error small in units is a
multiple of it, so that the ratio of the two tells nothing."""


@dataclass(frozen=True, kw_only=True)
class Channel:
    """One number the estimator recovers."""

    name: str
    unit: str
    scale: float
    """Physical unit per unit of the estimate."""


class Moments:
    """Mean and variance of a stream of vectors, in float64 and without keeping it (Chan, Golub and LeVeque 1983)."""

    def __init__(self, width: int) -> None:
        """Start with nothing seen."""
        self.count = 0
        self.mean = torch.zeros(width, dtype=torch.float64)
        """Shape (width,)."""
        self.squares = torch.zeros(width, dtype=torch.float64)
        """Summed squared deviations from the mean, shape (width,)."""

    def add(self, values: Tensor) -> None:
        """Take in some vectors, shape (n, width)."""
        if not len(values):
            return
        part, values = Moments(values.shape[1]), values.double()
        part.count, part.mean = len(values), values.mean(dim=0)
        part.squares = (values - part.mean).square().sum(dim=0)
        self.merge(part)

    def merge(self, other: Moments) -> None:
        """Take in everything another one has seen."""
        if other.count == 0:
            return
        total, shift = self.count + other.count, other.mean - self.mean
        self.squares = self.squares + other.squares + shift.square() * (self.count * other.count / total)
        self.mean = self.mean + shift * (other.count / total)
        self.count = total

    @property
    def mean_square(self) -> Tensor:
        """Mean of the squares, shape (width,)."""
        return self.squares / self.count + self.mean.square()


@dataclass(frozen=True, kw_only=True)
class ChannelScore:
    """How well one channel is recovered."""

    explained: float | None
    """Explained variance, 1 - Var(error) / Var(target); None where the target varies less than ``MIN_SPREAD``."""
    rmse: float
    """Root of the mean squared error, bias included [unit of the channel]."""
    prior: float
    """Standard deviation of the target: the error of always answering its mean [unit of the channel]."""


@dataclass(frozen=True, kw_only=True)
class EstimatorReport:
    """Scores of every channel, in the order of ``channels``."""

    channels: tuple[Channel, ...]
    samples: Mapping[str, int]
    """Of each robot."""
    robots: Mapping[str, tuple[ChannelScore, ...]]
    """Of each robot by itself."""
    fleet: tuple[ChannelScore, ...]
    """Of all robots in one heap, where telling the robots apart explains most."""
    within: tuple[ChannelScore, ...]
    """Variances are about each robot's own mean, so that telling the robots apart explains nothing; the prior is that
    of somebody who knows the robot."""


class Sampled:
    """Moments of target and error."""

    def __init__(self, width: int) -> None:
        """Start with nothing seen of so many channels."""
        self.target, self.error = Moments(width), Moments(width)

    def add(self, estimate: Tensor, target: Tensor) -> None:
        """Take in estimates and what they should have been, shape (n, width) each."""
        self.target.add(target)
        self.error.add(estimate.double() - target.double())


@torch.inference_mode()
def judge_estimator(
    actor: EagleActor,
    make_env: MakeEnv,
    robots: Sequence[str],
    task: TaskCfg,
    ev: EvaluationCfg,
    channels: Sequence[Channel],
) -> EstimatorReport:
    """Let robots with randomized bodies follow drawn commands, with noise and pushes, and compare what they estimate.

    Environments that fell are left out from then on.

    Args:
        actor: the policy.
        make_env: builds the environments.
        robots: robots to judge on.
        task: the task the policy was trained in; randomization is the full table, however narrow it was in training.
        ev: environments per robot, steps, seed and physics.
        channels: what the first columns of the observation group "estimate" hold; others are left out.

    Raises:
        ConfigError: there are no samples: too few steps, or everybody fell.
    """
    ev = replace(ev, protocol="joint", resampling_time_s=REDRAW_S, randomization=True, noise=True)
    task = evaluation_task(replace(task, randomization=RandomizationCfg()), ev)
    if ev.num_steps <= _warm_up(task):
        raise ConfigError(
            f"--steps {ev.num_steps} is {ev.num_steps * step_dt(task):g} s; sampling begins after {WARM_UP_S:g} s, "
            f"give at least {_warm_up(task) + 1}."
        )
    sampled = {robot: _sample(actor, make_env, robot, task, ev, len(channels)) for robot in robots}
    return report(sampled, channels)


def _warm_up(task: TaskCfg) -> int:
    """Control steps before the first sample."""
    return round(WARM_UP_S / step_dt(task))


def _sample(actor: EagleActor, make_env: MakeEnv, robot: str, task: TaskCfg, ev: EvaluationCfg, width: int) -> Sampled:
    """Roll out one robot."""
    env = make_env([robot], ev.num_envs_per_robot, task, ev.seed)
    commands = draw_commands(task.commands, ev, robot, ev.num_envs_per_robot)
    warm_up, stride = _warm_up(task), round(STRIDE_S / step_dt(task))
    alive = torch.ones(ev.num_envs_per_robot, dtype=torch.bool)
    sampled = Sampled(width)
    for t in range(ev.num_steps):
        if t % steps_per_draw(ev) == 0:
            env.pin_commands(commands[:, t // steps_per_draw(ev)])
        obs = env.get_observations()
        actions = actor(obs)
        if t >= warm_up and (t - warm_up) % stride == 0:
            sampled.add(actor.estimate.cpu()[alive, :width], obs["estimate"].cpu()[alive, :width])
        alive &= ~env.step(actions)[2].bool().cpu()
    return sampled


def report(sampled: Mapping[str, Sampled], channels: Sequence[Channel]) -> EstimatorReport:
    """Scores of what was sampled, by robot; robots that fell before the first sample are left out."""
    sampled = {robot: own for robot, own in sampled.items() if own.target.count}
    if not sampled:
        raise ConfigError("Nothing to judge the estimator on: every robot fell within its first second.")
    heap = Sampled(len(channels))
    for own in sampled.values():
        heap.target.merge(own.target)
        heap.error.merge(own.error)
    of_target, of_error = (
        torch.stack([getattr(own, x).squares for own in sampled.values()]).sum(dim=0) for x in ("target", "error")
    )
    return EstimatorReport(
        channels=tuple(channels),
        samples={robot: own.target.count for robot, own in sampled.items()},
        robots={robot: _scores(channels, own, own.target.squares, own.error.squares) for robot, own in sampled.items()},
        fleet=_scores(channels, heap, heap.target.squares, heap.error.squares),
        within=_scores(channels, heap, of_target, of_error),
    )


def _scores(channels: Sequence[Channel], sampled: Sampled, target: Tensor, error: Tensor) -> tuple[ChannelScore, ...]:
    """Scores of each channel, with summed squared deviations of target and error from the means that count."""
    count = sampled.target.count
    columns = zip(channels, target.tolist(), error.tolist(), sampled.error.mean_square.tolist(), strict=True)
    return tuple(
        ChannelScore(
            explained=1.0 - of_error / of_target if of_target >= MIN_SPREAD**2 * count else None,
            rmse=channel.scale * math.sqrt(mean_square),
            prior=channel.scale * math.sqrt(of_target / count),
        )
        for channel, of_target, of_error, mean_square in columns
    )
