"""TensorBoard's file format, written in the foreground: a failure to write is raised where it can be handled."""

from __future__ import annotations

import io
import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from eagle_rl.runners.files import append_whole


class EventFile:
    """One event per iteration, holding all its scalars; whole events only, also after a full disk."""

    def __init__(self, folder: Path) -> None:
        """Choose a name; the file begins with its first event."""
        self._path = folder / f"events.out.tfevents.{time.time_ns() // 1000}.{socket.gethostname()}.{os.getpid()}"
        self._begun = False

    def write(self, iteration: int, scalars: Mapping[str, float]) -> None:
        """Append the scalars of one iteration, by tag.

        A file that begins here makes TensorBoard drop what earlier files say about this iteration and beyond.

        Raises:
            OSError: nothing was written; the next call tries again, in a new file if this one has vanished.
        """
        if self._begun and not self._path.exists():
            self._begun = False
            raise FileNotFoundError(f"{self._path} has vanished")
        values = [Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()]
        events = [Event(step=iteration, summary=Summary(value=values))]
        if not self._begun:
            start = Event(step=iteration, session_log=SessionLog(status=SessionLog.START))
            events = [Event(file_version="brain.Event:2"), start, *events]
        records = io.BytesIO()
        for event in events:
            event.wall_time = time.time()
            RecordWriter(records).write(event.SerializeToString())
        append_whole(self._path, records.getvalue())
        self._begun = True
