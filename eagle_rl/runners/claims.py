"""Who works on a stage: claims that processes and machines sharing a folder make atomically and can take over.

A claim is a generation: the file ``claim.N``, linked into place so that it appears whole and only once. The highest
generation holds. A holder touches its file while it works; once the file has not been touched for STALE_AFTER_S, or its
process is known to be dead, anyone may create the next generation, which exactly one will manage.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
import time
import uuid
from pathlib import Path
from types import TracebackType

HEARTBEAT_S = 5.0
STALE_AFTER_S = 60.0


class ClaimLostError(RuntimeError):
    """Someone took the claim over because this process looked dead; its work on the stage must stop."""


def _generations(folder: Path) -> list[tuple[int, Path]]:
    """Claims of a stage, oldest first."""
    return sorted((int(path.suffix[1:]), path) for path in folder.glob("claim.*") if path.suffix[1:].isdigit())


def _process_is_dead(pid: int) -> bool:
    """Whether no process of this machine has the id."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False


def _read(claim: Path) -> tuple[str, int]:
    """Host and process id of who made a claim; ``?`` and 0 if that cannot be read."""
    try:
        made_by = json.loads(claim.read_text(encoding="utf-8"))
        return str(made_by["host"]), int(made_by["pid"])
    except (ValueError, KeyError, TypeError):
        return "?", 0


def _is_stale(claim: Path, now: float) -> bool:
    """Whether the claim's holder is gone; ``now`` is the file system's clock."""
    try:
        host, pid = _read(claim)
        age = now - claim.stat().st_mtime
    except FileNotFoundError:
        return False
    return age > STALE_AFTER_S or (host == socket.gethostname() and _process_is_dead(pid))


def holder(folder: Path) -> str | None:
    """``host:pid`` of who works on a stage, None if nobody does."""
    generations = _generations(folder)
    if not generations or _is_stale(generations[-1][1], time.time()):
        return None
    try:
        host, pid = _read(generations[-1][1])
    except FileNotFoundError:
        return None
    return f"{host}:{pid}"


class Claim:
    """A held claim; a context that keeps it alive and lets go of it at the end."""

    def __init__(self, folder: Path, path: Path) -> None:
        """Wrap a claim file that this process has just created."""
        self.folder = folder
        self.path = path
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True, name=f"heartbeat {path}")

    @classmethod
    def acquire(cls, folder: Path) -> Claim | None:
        """Claim a stage's folder, or return None while someone else works on it."""
        folder.mkdir(parents=True, exist_ok=True)
        draft = folder / f".claim-{uuid.uuid4().hex}"
        try:
            draft.write_text(json.dumps({"host": socket.gethostname(), "pid": os.getpid()}), encoding="utf-8")
            generations = _generations(folder)
            if generations and not _is_stale(generations[-1][1], draft.stat().st_mtime):
                return None
            path = folder / f"claim.{generations[-1][0] + 1 if generations else 0}"
            os.link(draft, path)
        except FileExistsError:
            return None
        finally:
            draft.unlink(missing_ok=True)
        return cls(folder, path)

    def check(self) -> None:
        """Raise if another has taken the claim over; a folder that has vanished was taken over by nobody."""
        generations = _generations(self.folder)
        if generations and generations[-1][0] > int(self.path.suffix[1:]):
            raise ClaimLostError(f"{self.folder}: taken over by another process")

    def __enter__(self) -> Claim:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self.path.unlink(missing_ok=True)

    def _beat(self) -> None:
        """Touch the claim until told to stop."""
        while not self._stop.wait(HEARTBEAT_S):
            with contextlib.suppress(OSError):  # the folder may vanish and come back
                os.utime(self.path)
