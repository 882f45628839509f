"""Files that are whole at every moment, and what to do while a disk is full."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from eagle_rl.runners.throttle import ThrottledWarning

T = TypeVar("T")

PATIENCE_S = 600.0
"""How long a run waits for room before it gives up what it cannot go on without [s]."""
RETRY_S = 5.0


def write_atomically(path: Path, data: bytes) -> None:
    """Replace ``path`` by ``data``: at any moment it is the old file or the new one, also after a power cut."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:  # a full disk does not say whose file it was
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def append_whole(path: Path, data: bytes) -> None:
    """Append all of ``data`` or, on a full disk, nothing."""
    with path.open("ab", buffering=0) as file:
        start = file.tell()
        if file.write(data) != len(data):
            file.truncate(start)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def patiently(write: Callable[[], T]) -> T:
    """Write what a run cannot go on without: while that fails wait, and say so once a minute.

    Raises:
        OSError: it failed for ``PATIENCE_S``.
    """
    warn, deadline = ThrottledWarning(), time.monotonic() + PATIENCE_S
    while True:
        try:
            return write()
        except OSError as error:
            if time.monotonic() >= deadline:
                raise
            warn(f"{error}. The run cannot go on without it and waits, for {PATIENCE_S / 60:.0f} min at most.")
        time.sleep(RETRY_S)
