"""Arguments that several verbs take, checked before any work is done."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from eagle_rl.errors import ConfigError

MAX_COUNT = 1_000_000
MAX_SECONDS = 1e6


def count(text: str) -> int:
    """A whole number above zero; a ``type`` for argparse."""
    if not (text.isascii() and text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a whole number above 0")
    if int(text) > MAX_COUNT:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected at most {MAX_COUNT}")
    return int(text)


def seconds(text: str) -> float:
    """A time from 0 to a million seconds; a ``type`` for argparse."""
    try:
        time = float(text)
    except ValueError:
        time = -1.0
    if not 0.0 <= time <= MAX_SECONDS:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a time in seconds, at most {MAX_SECONDS:g}")
    return time


def duration(text: str) -> float:
    """A time above zero [s]; a ``type`` for argparse."""
    if seconds(text) == 0.0:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a time above zero")
    return seconds(text)


def device(text: str) -> str:
    """``cpu``, ``cuda`` or ``cuda:N``; a ``type`` for argparse."""
    kind, colon, number = text.partition(":")
    if text != "cpu" and (kind != "cuda" or (colon and not number.isdecimal())):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected cpu, cuda or cuda:N")
    return text


def require_device(name: str) -> None:
    """Refuse a device that torch does not find here."""
    import torch

    if name != "cpu" and not torch.cuda.is_available():
        raise ConfigError(f"device {name} is not available here: torch finds no CUDA device. Use cpu.")


def require_folder(path: Path) -> None:
    """Refuse a folder that cannot be made or written, before work is put into what it is to hold."""
    nearest = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not nearest.is_dir():
        raise ConfigError(f"--out {path}: {nearest} is a file. Name another folder.")
    if not os.access(nearest, os.W_OK):
        raise ConfigError(f"--out {path}: {nearest} may not be written. Name another folder.")
