"""Where an iteration's time goes: ``eagle bench profile``."""

from __future__ import annotations

import time
from collections import Counter

from .measure import Figure
from .workloads import experiment, make_env, make_runner


def profile(num_envs: int, threads: int, iterations: int = 5) -> list[Figure]:
    """Shares of an iteration by the stopwatch every run has, and of what no core did.

    ``idle`` is the part of ``threads`` cores that was not used, whatever the reason.
    """
    cfg = experiment(threads)
    runner = make_runner(cfg, make_env(cfg, num_envs))
    runner.alg.compile_from = 0
    runner.learn(2)
    seconds: Counter[str] = Counter()

    def add(_: int) -> None:
        seconds.update(runner.alg.stopwatch.seconds)

    wall, cpu = time.perf_counter(), time.process_time()
    runner.learn(iterations, on_iteration=add)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    steps = iterations * cfg.algo.num_steps_per_env * num_envs
    rows = [
        Figure(name, s / wall, "share", "", f"{1e3 * s / iterations:.0f} ms, {1e6 * s / steps:.1f} us a step")
        for name, s in sorted(seconds.items(), key=lambda item: -item[1])
    ]
    idle = Figure("idle", max(0.0, 1.0 - cpu / (wall * threads)), "share", "", f"of {threads} cores")
    return [*rows, idle]
