"""Where the time of an iteration goes, by a look at the clock after each of its parts."""

from __future__ import annotations

import time

SECTIONS = ("physics", "MDP", "inference", "storage", "gradient", "optimiser", "logging")
"""Parts of an iteration: ``physics`` includes checking and gathering the states, ``gradient`` gathering minibatches
and the forward and backward passes of all losses. On a GPU a part's time is that of asking for it."""


class Stopwatch:
    """Seconds spent in each section; what is not booked to any belongs to the next one."""

    def __init__(self) -> None:
        """Start now."""
        self.reset()

    def reset(self) -> None:
        """Start anew."""
        self.seconds = dict.fromkeys(SECTIONS, 0.0)
        self._last = time.perf_counter()

    def lap(self, section: str) -> None:
        """Book the time since the last lap."""
        now = time.perf_counter()
        self.seconds[section] += now - self._last
        self._last = now

    def move(self, seconds: float, source: str, target: str) -> None:
        """Book to ``target`` a part of what was booked to ``source`` [s]."""
        self.seconds[source] -= seconds
        self.seconds[target] += seconds
