"""Threads that share out tasks and sleep in between. MuJoCo steps without the interpreter's lock, so they run abreast.

Threads that spin while they wait would take the cores from whoever else works on the machine.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

T = TypeVar("T")


def _usable_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """Threads of this process, the caller's among them."""

    def __init__(self, num_threads: int) -> None:
        """Be so many threads, 0 for one per core."""
        self.num_threads = num_threads or _usable_cores()
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def do(self, task: Callable[[T], object], items: Sequence[T]) -> None:
        """Do a task with every item: whoever is free takes the next one. What it raises is raised when all are over.

        The caller takes part, and waits for nobody to whom a busy machine has yet to give a core.
        """
        queue = iter(list(items))  # a list's iterator gives each item to one thread, whoever asks

        def work() -> None:
            for item in queue:
                task(item)

        others = [self._others().submit(work) for _ in range(min(self.num_threads, len(items)) - 1)]
        try:
            work()
        finally:
            begun = [other for other in others if not other.cancel()]
            wait(begun)
        for other in begun:
            other.result()

    def _others(self) -> ThreadPoolExecutor:
        """The other threads, made when first needed: a forked process has none of its parent's."""
        if self._pool is None or self._process != os.getpid():
            self._pool = ThreadPoolExecutor(self.num_threads - 1, "physics")
            self._process = os.getpid()
        return self._pool
