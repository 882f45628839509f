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


class _Threads:
    """Threads of this process, the caller's among them."""

    def __init__(self) -> None:
        self.count = 1
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def resize(self, count: int) -> None:
        """Be so many from now on."""
        if self._pool is not None and self._process == os.getpid():
            self._pool.shutdown()
        self.count, self._pool = count, None

    def map(self, do: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
        """See :func:`share_out`."""
        futures = [self._helpers().submit(do, task) for task in tasks]
        own: dict[int, Result] = {}
        try:
            for i in reversed(range(len(tasks))):
                if futures[i].cancel():
                    own[i] = do(tasks[i])
        finally:
            wait([future for future in futures if not future.cancel()])
        return [own[i] if i in own else future.result() for i, future in enumerate(futures)]

    def _helpers(self) -> ThreadPoolExecutor:
        """The others, made when first needed: a forked process has none of its parent's."""
        if self._pool is None or self._process != os.getpid():
            # Asked for its number of threads, torch sets it in the thread that asks; some of its libraries do not ask.
            self._pool = ThreadPoolExecutor(self.count - 1, "share", initializer=torch.get_num_threads)
            self._process = os.getpid()
        return self._pool


_threads = _Threads()


def use_threads(count: int) -> None:
    """Share work out among so many threads of this process from now on."""
    _threads.resize(count)


def num_threads() -> int:
    """How many threads work is shared out among, the caller's among them."""
    return _threads.count


def share_out(do: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
    """What ``do`` returns for each task, in their order; what it raises for one is raised when all are over.

    The caller begins with the last and takes what nobody else has begun, so that it does not wait for a thread to which
    a busy machine has yet to give a core. Modes of torch that the caller has set hold in its own thread only.
    """
    if _threads.count == 1 or len(tasks) == 1:
        return [do(task) for task in tasks]
    return _threads.map(do, tasks)
