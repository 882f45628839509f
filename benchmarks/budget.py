"""Where the time of some code goes: methods are watched from outside, so that the code stays free of timers."""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from types import TracebackType
from typing import Any

from typing_extensions import Self


class Budget:
    """Time spent in watched methods and in none of their watched callees, by section, while entered.

    ``wall`` is what passed; ``cpu`` is what all threads of the process worked in it, so that a section that waits, or
    is kept from its core by other processes, shows more wall than CPU time.
    """

    def __init__(self) -> None:
        """Watch nothing."""
        self.wall: defaultdict[str, float] = defaultdict(float)
        self.cpu: defaultdict[str, float] = defaultdict(float)
        self._watched: list[tuple[Any, str, str, bool]] = []
        self._originals: list[tuple[Any, str, Any]] = []
        self._stack: list[str] = []
        self._whole = False
        self._last = (0.0, 0.0)

    def watch(self, owner: Any, method: str, section: str, whole: bool = False) -> None:
        """Book the time of a class's, module's or object's method under ``section``, ``whole`` with its callees."""
        self._watched.append((owner, method, section, whole))

    def __enter__(self) -> Self:
        """Start; time outside of all watched methods is booked as ``other``."""
        for owner, method, section, whole in self._watched:
            self._originals.append((owner, method, vars(owner).get(method)))
            setattr(owner, method, self._timed(getattr(owner, method), section, whole))
        self._last = (time.perf_counter(), time.process_time())
        self._stack = ["other"]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop, and put the methods back."""
        self._book()
        for owner, method, original in reversed(self._originals):
            if original is None:
                delattr(owner, method)
            else:
                setattr(owner, method, original)
        self._originals = []

    def _book(self) -> None:
        """Charge what has passed to the section now running."""
        now = (time.perf_counter(), time.process_time())
        section = self._stack[-1]
        self.wall[section] += now[0] - self._last[0]
        self.cpu[section] += now[1] - self._last[1]
        self._last = now

    def _timed(self, function: Any, section: str, whole: bool) -> Any:
        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            if self._whole:
                return function(*args, **kwargs)
            self._book()
            self._stack.append(section)
            self._whole = whole
            try:
                return function(*args, **kwargs)
            finally:
                self._book()
                self._stack.pop()
                self._whole = False

        return timed
