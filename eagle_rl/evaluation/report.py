"""The tracking table: robots by methods by five errors, with floors and the paper's numbers."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Literal

from eagle_rl.config.schema import EvaluationCfg, Range
from eagle_rl.errors import ConfigError
from eagle_rl.evaluation.evaluate import EvaluationResult
from eagle_rl.evaluation.falls import Fall
from eagle_rl.evaluation.metrics import RobotMetrics
from eagle_rl.evaluation.protocol import COMMANDS, num_draws
from eagle_rl.evaluation.reference import PAPER, PAPER_H1, Errors, floors, score_units

Falls = Literal["charged", "errors"]
"""``charged`` counts |c_d| for every step after a fall, ``errors`` leaves those steps out."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One error of one method on one robot."""

    mean: float | None
    std: float | None = None
    """Over seeds; None for one seed."""
    paper: float | None = None


@dataclass(frozen=True, kw_only=True)
class Row:
    """One method on one robot."""

    robot: str
    method: str
    cells: tuple[Cell, ...]
    unseen: bool = False
    """Whether the method was not trained on the robot."""
    survival: Cell | None = None
    seeds: tuple[int, ...] = ()
    """Training seeds; empty for a reference row."""
    env_steps: float | None = None
    """Mean cost of a seed's run, if known."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows grouped by robot, and what has to be known to repeat them."""

    rows: tuple[Row, ...]
    caption: str
    checkpoints: Mapping[str, tuple[str, ...]]
    """sha256 of every checkpoint, by method."""


def pooled_score(robots: Mapping[str, RobotMetrics], ev: EvaluationCfg, ranges: Sequence[Range]) -> float:
    """Mean over robots and commands of the charged error as a share of standing still: 0 is perfect, 1 is idle."""
    shares = [
        charged / unit
        for metrics in robots.values()
        for charged, unit in zip(metrics.subsets["all"].charged, score_units(ev, ranges), strict=True)
        if charged is not None
    ]
    return statistics.fmean(shares)


def _over_seeds(values: Sequence[float | None], paper: float | None = None) -> Cell:
    """Mean and standard deviation of what several seeds scored."""
    known = [v for v in values if v is not None]
    return Cell(
        mean=statistics.fmean(known) if known else None,
        std=statistics.stdev(known) if len(known) > 1 else None,
        paper=paper,
    )


_DRAWN = {
    "single": "four commands zero, the other drawn",
    "joint": "all five commands drawn",
    "upright": "height and pitch zero, velocities drawn",
    "standing": "velocities exactly zero, height and pitch drawn",
}


def describe(ev: EvaluationCfg, subset: str, falls: Falls) -> str:
    """The protocol in words."""
    by_turns = ev.protocol == "standing" and num_draws(ev) > 1
    drawn = "velocities exactly zero in every second draw, all else drawn" if by_turns else _DRAWN[ev.protocol]
    held = f"redrawn every {ev.resampling_time_s:g} s" if ev.resampling_time_s > 0 else "kept for the episode"
    dynamics = "randomized dynamics and pushes" if ev.randomization else "nominal dynamics"
    after = "steps after a fall are charged |c_d|" if falls == "charged" else "steps after a fall are left out"
    return (
        f"Mean absolute tracking error over {ev.num_envs_per_robot} environments x {ev.num_steps} steps a robot; "
        f"{drawn} from the finishing ranges, {held}; {dynamics}, {'noisy' if ev.noise else 'clean'} sensors, physics "
        f"{ev.physics_dt:g} s x {ev.decimation}, seed {ev.seed}; subset: {subset}; {after}."
    )


def common_protocol(protocols: Iterable[EvaluationCfg]) -> EvaluationCfg:
    """The protocol all results share.

    Raises:
        ConfigError: they do not share one; names what differs.
    """
    first, *others = dict.fromkeys(protocols)
    if others:
        differs = [f.name for f in fields(first) if any(getattr(ev, f.name) != getattr(first, f.name) for ev in others)]
        raise ConfigError(
            f"A table needs results of one protocol, got {len(others) + 1}, which differ in {', '.join(differs)}: "
            "evaluate all methods alike."
        )
    return first


def common_ranges(ranges: Iterable[tuple[Range, ...]]) -> tuple[Range, ...]:
    """What the commands of all results were drawn from.

    Raises:
        ConfigError: from different ranges.
    """
    first, *others = dict.fromkeys(ranges)
    if others:
        raise ConfigError(
            f"A table needs results of the same commands, got {len(others) + 1} sets of finishing ranges: "
            "evaluate all methods alike."
        )
    return first


def tracking_table(
    results: Mapping[str, Sequence[EvaluationResult]],
    subset: str = "all",
    falls: Falls = "charged",
    paper: Mapping[str, Mapping[str, Errors]] = {**PAPER, **PAPER_H1},
) -> Table:
    """Gather results into a table.

    Args:
        results: by method, one result per training seed.
        subset: one of ``metrics.SUBSETS``; the floors are of all steps and are left out for others.
        falls: what counts after a fall.
        paper: the paper's errors by method and robot; not shown for robots a method was not trained on, nor
            for upright or standing robots, which the paper does not judge by themselves.
    """
    every = [result for runs in results.values() for result in runs]
    ev, ranges = common_protocol(result.protocol for result in every), common_ranges(result.ranges for result in every)
    paper = paper if ev.protocol in ("single", "joint") else {}
    robots = list(dict.fromkeys(robot for result in every for robot in result.robots))
    rows = []
    for robot in robots:
        if subset == "all":
            rows += [
                Row(robot=robot, method=name, cells=tuple(Cell(mean=e) for e in errors))
                for name, errors in floors(ev, ranges).items()
            ]
        for method, runs in results.items():
            judged = [run for run in runs if robot in run.robots]
            if judged:
                rows.append(_row(robot, method, judged, subset, falls, paper.get(method, {}).get(robot)))
    return Table(
        rows=tuple(rows),
        caption=describe(ev, subset, falls),
        checkpoints={method: tuple(run.checkpoint for run in runs) for method, runs in results.items()},
    )


def falls_of(results: Mapping[str, Sequence[EvaluationResult]]) -> dict[tuple[str, str], tuple[list[Fall], int]]:
    """By robot and method: falls over all seeds, and how many environments there were.

    Args:
        results: by method, one result per training seed.
    """
    robots = dict.fromkeys(robot for runs in results.values() for run in runs for robot in run.robots)
    judged = {
        (robot, method): [run.robots[robot] for run in runs if robot in run.robots]
        for robot in robots
        for method, runs in results.items()
    }
    return {
        names: ([fall for each in some for fall in each.falls], sum(each.num_envs for each in some))
        for names, some in judged.items()
    }


def _row(
    robot: str, method: str, runs: Sequence[EvaluationResult], subset: str, falls: Falls, paper: Errors | None
) -> Row:
    """One method on one robot, over its seeds."""
    errors = [getattr(run.robots[robot].subsets[subset], falls) for run in runs]
    unseen = any(robot in run.unseen for run in runs)
    printed = (None,) * len(COMMANDS) if paper is None or unseen else paper
    return Row(
        robot=robot,
        method=method,
        unseen=unseen,
        cells=tuple(_over_seeds([e[d] for e in errors], printed[d]) for d in range(len(COMMANDS))),
        survival=_over_seeds([run.robots[robot].survival for run in runs]),
        seeds=tuple(run.seed for run in runs),
        env_steps=_over_seeds([run.env_steps for run in runs]).mean,
    )
