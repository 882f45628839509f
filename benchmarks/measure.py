"""Figures: medians of what is measured in turns, so that a busy machine slows both sides of a ratio."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median


@dataclass(frozen=True)
class Figure:
    """One row of the table."""

    name: str
    value: float
    unit: str
    """``x`` for a ratio."""
    bar: str
    """What it should be, empty where it only informs."""
    detail: str
    """Medians it was made from."""


@dataclass(frozen=True)
class Cost:
    """Medians of one thing that was measured in turns with others, and its mean [s]."""

    wall: float
    cpu: float
    """Of all threads of the process; what the kernel has booked, so it wants many rounds where threads are short."""
    mean: float
    """Wall time with what is rare and takes longer, which medians do not show: resets, and whatever else has a core."""


def in_turns(
    actions: Mapping[str, Callable[[], object]],
    seconds: float,
    warm_up: int = 3,
    before: Mapping[str, Callable[[], object]] | None = None,
) -> dict[str, Cost]:
    """Do every action in turn until the time is up; their costs.

    Args:
        actions: what to measure, by name.
        seconds: how long to go on [s]; at least five rounds are made.
        warm_up: rounds that are not counted.
        before: what is done before an action and not measured, by the action's name.
    """
    walls: dict[str, list[float]] = {name: [] for name in actions}
    cpus: dict[str, list[float]] = {name: [] for name in actions}
    end, rounds = time.perf_counter() + seconds, 0
    while rounds < warm_up + 5 or time.perf_counter() < end:
        for name, action in actions.items():
            if before is not None and name in before:
                before[name]()
            wall, cpu = time.perf_counter(), time.process_time()
            action()
            walls[name].append(time.perf_counter() - wall)
            cpus[name].append(time.process_time() - cpu)
        rounds += 1
    return {name: _cost(walls[name][warm_up:], cpus[name][warm_up:]) for name in actions}


def _cost(walls: Sequence[float], cpus: Sequence[float]) -> Cost:
    """What the rounds say that are counted."""
    return Cost(median(walls), median(cpus), fmean(walls))


def milliseconds(**seconds: float) -> str:
    """The detail of a figure: some durations by name."""
    return ", ".join(f"{name.replace('_', ' ')} {1e3 * value:.1f} ms" for name, value in seconds.items())
