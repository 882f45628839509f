"""Who works on a stage: claims that processes and machines sharing a folder make atomically and can take over.

A claim is a generation: the file ``claim.N``, linked into place so that it appears whole and only once. The highest
generation holds. A holder touches its file while it works; once the file has not been touched for STALE_AFTER_S, or its
process is known to be dead, anyone may create the next generation, which exactly one will manage.
"""

from __future__ import annotations

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


def _is_stale(claim: Path, now: float) -> bool:
    """Whether the claim's holder is gone; ``now`` is the file system's clock."""
    try:
        holder = json.loads(claim.read_text(encoding="utf-8"))
        age = now - claim.stat().st_mtime
    except FileNotFoundError:
        return False
    return age > STALE_AFTER_S or (holder["host"] == socket.gethostname() and _process_is_dead(holder["pid"]))


def holder(folder: Path) -> str | None:
    """``host:pid`` of who works on a stage, None if nobody does."""
    generations = _generations(folder)
    if not generations or _is_stale(generations[-1][1], time.time()):
        return None
    try:
        claim = json.loads(generations[-1][1].read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    return f"{claim['host']}:{claim['pid']}"


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
        draft.write_text(json.dumps({"host": socket.gethostname(), "pid": os.getpid()}), encoding="utf-8")
        try:
            generations = _generations(folder)
            if generations and not _is_stale(generations[-1][1], draft.stat().st_mtime):
                return None
            path = folder / f"claim.{generations[-1][0] + 1 if generations else 0}"
            os.link(draft, path)
        except FileExistsError:
            return None
        finally:
            draft.unlink()
        return cls(folder, path)

    def check(self) -> None:
        """Raise unless the claim is still ours."""
        generations = _generations(self.folder)
        if not generations or generations[-1][1] != self.path:
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
        """Touch the claim until told to stop or it is gone."""
        while not self._stop.wait(HEARTBEAT_S) and self.path.exists():
            os.utime(self.path)
