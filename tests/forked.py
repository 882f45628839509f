"""A process that is forked while its parent has threads."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from typing import Any


def exit_code_in_fork(target: Callable[..., None], *args: Any) -> int | None:
    """What a forked process that calls ``target`` ends with; it fails where the process does not end."""
    child = multiprocessing.get_context("fork").Process(target=target, args=args)
    child.start()
    child.join(60)
    hangs = child.is_alive()
    if hangs:
        child.kill()
        child.join()
    assert not hangs, "the child waits for threads of its parent"
    return child.exitcode
