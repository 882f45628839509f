"""Work shared out among threads, which is how learning on a CPU uses more than one core.

torch's own threads are OpenMP's. They wait for each other by spinning, and where other work has the cores as well an
update takes 3.5 to 20 times as long. The threads here wait asleep: on a busy machine they lose next to nothing.
"""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import TypeVar

import torch

Task = TypeVar("Task")
Result = TypeVar("Result")


class _Errand:
    """Work that the caller has begun and others may join."""

    def __init__(self, work: Callable[[], None], helpers: int) -> None:
        self.over: SimpleQueue[BaseException | None] = SimpleQueue()
        """What became of each helper's part."""
        self._work = work
        self._places = [None] * helpers

    def join(self) -> None:
        """Take part, unless all places are taken."""
        if not self.take_place():
            return
        try:
            self._work()
        except BaseException as error:  # the caller's to judge
            self.over.put(error)
        else:
            self.over.put(None)

    def take_place(self) -> bool:
        """Whether there was a place; it is taken then."""
        try:
            self._places.pop()  # one thread at a time
        except IndexError:
            return False
        return True


_Inbox = SimpleQueue[_Errand | None]


class Threads:
    """Threads of this process, the caller's among them.

    What passes between them are queues in C: with a pool of futures it takes the interpreter more than twice as long to
    hand over and to take back (``docs/performance.md``).
    """

    def __init__(self, count: int, name: str, prepare: Callable[[], object] = lambda: None) -> None:
        """Be so many; the others are called ``name``, and begin with ``prepare``."""
        self.count = count
        self._name = name
        self._prepare = prepare
        self._inbox: _Inbox | None = None
        self._process = 0
        self._others: list[threading.Thread] = []

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

        helpers = min(self.count, len(tasks)) - 1
        if helpers < 1:
            work()
        else:
            self._share(work, helpers)
        return [results[i] for i in range(len(tasks))]

    def _share(self, work: Callable[[], None], helpers: int) -> None:
        """Do work, which so many others may join, until all who did are through."""
        errand, inbox = _Errand(work, helpers), self._open()
        for _ in range(helpers):
            inbox.put(errand)
        try:
            work()
        finally:
            while errand.take_place():  # who has not begun is not needed any more
                helpers -= 1
            failures = [errand.over.get() for _ in range(helpers)]
        for failure in failures:
            if failure is not None:
                raise failure

    def end(self) -> None:
        """Let the other threads go, until they are needed again."""
        if self._inbox is not None and self._process == os.getpid():
            _dismiss(self._inbox, len(self._others))
            for other in self._others:
                other.join()
        self._inbox = None

    def _open(self) -> _Inbox:
        """Where the other threads wait, made when first needed: a forked process has none of its parent's."""
        if self._inbox is None or self._process != os.getpid():
            self._inbox, self._process = SimpleQueue(), os.getpid()
            self._others = [
                threading.Thread(target=_serve, args=(self._inbox, self._prepare), name=self._name, daemon=True)
                for _ in range(self.count - 1)
            ]
            for other in self._others:
                other.start()
            weakref.finalize(self, _dismiss, self._inbox, len(self._others))
        return self._inbox


def _serve(inbox: _Inbox, prepare: Callable[[], object]) -> None:
    """Take part in whatever comes, until dismissed."""
    torch.get_num_threads()  # asked for it, torch sets it in the thread that asks; some of its libraries do not ask
    prepare()
    while (errand := inbox.get()) is not None:
        errand.join()
        del errand  # and what it holds


def _dismiss(inbox: _Inbox, threads: int) -> None:
    """Let so many threads go."""
    for _ in range(threads):
        inbox.put(None)


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
