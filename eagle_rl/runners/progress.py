"""One line that says how far a run is."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from eagle_rl.algorithms.stopwatch import SECTIONS

LINE_INTERVAL_S = 10.0
"""Time between plain lines where the output is not a terminal [s]."""
BUDGET_INTERVAL = 50
"""Iterations between lines that say where the time went."""


class ProgressReport:
    """A progress bar with time left on a terminal, a plain line every ten seconds elsewhere; where the time goes."""

    def __init__(self, title: str, first: int, last: int, console: Console | None = None) -> None:
        """Report on iterations ``first`` to ``last``."""
        self._title = title
        self._first, self._last = first, last
        self._console = console or Console(stderr=True)
        self._start = self._last_line = time.monotonic()
        self._bar: Progress | None = None
        self._seconds: defaultdict[str, float] = defaultdict(float)

    def __enter__(self) -> ProgressReport:
        """Draw the bar."""
        if self._console.is_terminal:
            columns = (TextColumn("{task.description}"), BarColumn(None), TimeElapsedColumn(), TimeRemainingColumn())
            self._bar = Progress(*columns, console=self._console)
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=self._last, completed=self._first)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Leave the last state standing."""
        if self._bar is not None:
            self._bar.stop()

    def update(self, iteration: int, env_steps: int, scalars: Mapping[str, float]) -> None:
        """Report a finished iteration."""
        episodes = "no episode over yet"
        if "Train/mean_reward" in scalars:
            reward, length = scalars["Train/mean_reward"], scalars["Train/mean_episode_length"]
            episodes = f"reward {reward:.2f} | length {length:.0f}"
        if "Search/cost" in scalars:
            episodes = f"cost {scalars['Search/cost']:.3f} | survival {scalars['Search/survival']:.1%}"
        speed = f"{env_steps / 1e6:.2f}M steps | {scalars['Perf/total_fps']:.0f}/s"
        text = f"{self._title} {iteration}/{self._last} | {speed} | {episodes}"
        if self._bar is not None:
            self._bar.update(self._task, completed=iteration, description=text)
        elif time.monotonic() - self._last_line >= LINE_INTERVAL_S or iteration == self._last:
            self._last_line = time.monotonic()
            left = (self._last_line - self._start) / (iteration - self._first) * (self._last - iteration)
            self._console.print(f"{text} | {left / 60:.1f} min left", soft_wrap=True, highlight=False)
        self._count_time(iteration, scalars)

    def _count_time(self, iteration: int, scalars: Mapping[str, float]) -> None:
        """Add up where the time goes, and say so every ``BUDGET_INTERVAL`` iterations."""
        for section in SECTIONS:
            self._seconds[section] += scalars.get(f"Perf/{section}_time", 0.0)
        total = sum(self._seconds.values())
        if iteration % BUDGET_INTERVAL == 0 and total > 0:
            shares = ", ".join(f"{name} {seconds / total:.0%}" for name, seconds in self._seconds.items())
            busy = f"{scalars['Perf/busy_cores']:.1f} cores busy"
            self._console.print(f"{self._title} time: {shares} | {busy}", soft_wrap=True, highlight=False)
            self._seconds.clear()
