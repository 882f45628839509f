"""Work shared out among threads, which is how learning on a CPU uses more than one core.

torch's own threads are OpenMP's. They wait for each other by spinning, and where other work has the cores as well an
update takes 3.5 to 20 times as long. The threads here wait asleep: on a busy machine they lose next to nothing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

import torch

Task = TypeVar("Task")
Result = TypeVar("Result")


class Threads:
    """Threads of this process, the caller's among them."""

    def __init__(self, count: int, name: str) -> None:
        """Be so many; the others are called ``name``."""
        self.count = count
        self._name = name
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def share_out(self, do: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
        """What ``do`` returns for each task, in their order; what it raises for one is raised when all are over.

        Whoever is free takes the next task, and the caller is one of them: it does not wait for a thread to which a
        busy machine has yet to give a core. Modes of torch that the caller has set hold in its own thread only.
        """
        queue = iter(list(enumerate(tasks)))  # a list's iterator gives each item to one thread, whoever asks
        results: dict[int, Result] = {}

        def work() -> None:
            for i, task in queue:
                results[i] = do(task)

        others = [self._others().submit(work) for _ in range(min(self.count, len(tasks)) - 1)]
        try:
            work()
        finally:
            begun = [other for other in others if not other.cancel()]
            wait(begun)
        for other in begun:
            other.result()
        return [results[i] for i in range(len(tasks))]

    def end(self) -> None:
        """Let the other threads go, until they are needed again."""
        if self._pool is not None and self._process == os.getpid():
            self._pool.shutdown()
        self._pool = None

    def _others(self) -> ThreadPoolExecutor:
        """The other threads, made when first needed: a forked process has none of its parent's."""
        if self._pool is None or self._process != os.getpid():
            # Asked for its number of threads, torch sets it in the thread that asks; some of its libraries do not ask.
            self._pool = ThreadPoolExecutor(self.count - 1, self._name, initializer=torch.get_num_threads)
            self._process = os.getpid()
        return self._pool


_learner = Threads(1, "learner")


def use_threads(count: int) -> None:
    """Learn with so many threads of this process from now on."""
    global _learner
    _learner.end()
    _learner = Threads(count, "learner")


def num_threads() -> int:
    """How many threads learn, the caller's among them."""
    return _learner.count


def share_out(do: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
    """:meth:`Threads.share_out` among the threads that learn."""
    return _learner.share_out(do, tasks)
