"""TensorBoard's file format, written in the foreground: a failure to write is raised where it can be handled."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter


class EventFile:
    """One event per iteration, holding all its scalars."""

    def __init__(self, folder: Path, next_iteration: int) -> None:
        """Begin a file; TensorBoard drops what earlier files say about ``next_iteration`` and beyond."""
        name = f"events.out.tfevents.{time.time_ns() // 1000}.{socket.gethostname()}.{os.getpid()}"
        self._path = folder / name
        self._append(Event(file_version="brain.Event:2"), "xb")
        self._append(Event(step=next_iteration, session_log=SessionLog(status=SessionLog.START)))

    def write(self, iteration: int, scalars: Mapping[str, float]) -> None:
        """Append the scalars of one iteration, by tag."""
        values = [Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()]
        self._append(Event(step=iteration, summary=Summary(value=values)))

    def _append(self, event: Event, mode: str = "ab") -> None:
        event.wall_time = time.time()
        if mode == "ab" and not self._path.exists():
            raise FileNotFoundError(f"{self._path} has vanished")
        with self._path.open(mode) as file:
            RecordWriter(file).write(event.SerializeToString())
