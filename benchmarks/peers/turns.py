"""What a measured program does: it makes itself ready, then measures whenever it is told to.

Peers run in interpreters of their own, so this needs the standard library only.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

STEP, COLLECTION, ITERATION = "environment step", "collection", "whole iteration"

Rates = dict[str, float]
"""Env-steps/s by what was done."""

WARM_UP = 2
"""Iterations that are not counted."""


@dataclass(frozen=True)
class Setting:
    """What a program is to measure."""

    num_envs: int
    seconds: float
    """How long each rate is measured for in a turn [s]."""
    model: str = ""
    """MuJoCo model of our G1, for those who have no robot of their own."""
    decimation: int = 1
    """Physics steps of it in a control step."""
    variant: str = ""
    """Which of several ways to do it."""


@dataclass(frozen=True)
class About:
    """What a rate depends on."""

    versions: str
    control: str
    """Control rate and physics steps."""
    threads: str
    differs: str = ""
    """From ours."""


Prepare = Callable[[Setting], tuple[About, Callable[[], Rates]]]


def serve(prepare: Prepare) -> None:
    """Write a line about the program once it is ready, and one of rates for every line that is read, all in JSON.

    The program's arguments are a setting in JSON and the number of the open file to write to.
    """
    about, measure = prepare(Setting(**json.loads(sys.argv[1])))
    with os.fdopen(int(sys.argv[2]), "w", buffering=1) as answers:
        print(json.dumps(vars(about)), file=answers)
        for _ in sys.stdin:
            print(json.dumps(measure()), file=answers)


def control(decimation: int, physics_dt: float) -> str:
    """A control step in words."""
    return f"{1.0 / (decimation * physics_dt):.0f} Hz, {decimation} x {1e3 * physics_dt:.3g} ms"


def repeat(act: Callable[[], object], seconds: float) -> tuple[int, float]:
    """Do something until the time is up; how often it was done, and in what time [s]."""
    count, start = 0, time.perf_counter()
    while (passed := time.perf_counter() - start) < seconds:
        act()
        count += 1
    return count, passed


class Stepping:
    """An environment's steps."""

    def __init__(self, step: Callable[[], object], setting: Setting) -> None:
        """Step until the first falls are over."""
        self._step, self._setting = step, setting
        for _ in range(25):
            step()

    def rates(self) -> Rates:
        """What one turn measures."""
        count, passed = repeat(self._step, self._setting.seconds)
        return {STEP: count * self._setting.num_envs / passed}


class Training:
    """A runner of rsl_rl's kind; what of an iteration is not its update is its collection."""

    def __init__(self, runner: Any, steps_per_env: int, setting: Setting) -> None:
        """Warm up, which is when kernels are compiled."""
        self._runner, self._seconds = runner, setting.seconds
        self._env_steps = steps_per_env * setting.num_envs
        self._updating = 0.0
        runner.learn(WARM_UP, init_at_random_ep_len=True)
        self._update, runner.alg.update = runner.alg.update, self._timed

    def rates(self) -> Rates:
        """What one turn measures."""
        self._updating = 0.0
        count, passed = repeat(lambda: self._runner.learn(1, init_at_random_ep_len=False), self._seconds)
        done = count * self._env_steps
        return {COLLECTION: done / (passed - self._updating), ITERATION: done / passed}

    def _timed(self) -> Any:
        start = time.perf_counter()
        losses = self._update()
        self._updating += time.perf_counter() - start
        return losses
