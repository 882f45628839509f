"""Every error a user can cause, each with the exit code the command line returns for it.

A message says what is wrong, what was found, what was expected, the nearest valid choice where there is one, and how
to mend it. Commands print the message alone; a traceback is a fault of ours.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class EagleError(Exception):
    """Root of the errors that a command reports in words instead of with a traceback."""

    exit_code = 2


class ConfigError(EagleError, ValueError):
    """Configuration files or command-line overrides are wrong; carries every fault found, not only the first."""

    def __init__(self, faults: str | Iterable[str]) -> None:
        """Join the faults into one message, one line each."""
        self.faults = [faults] if isinstance(faults, str) else list(faults)
        super().__init__("\n".join(self.faults))


class RobotError(EagleError, ValueError):
    """A robot's URDF or YAML cannot be used."""

    exit_code = 3


class HealthError(EagleError, RuntimeError):
    """A run was stopped because simulation or learning became unsound; a checkpoint was written first."""

    exit_code = 4


class CheckpointError(EagleError, ValueError):
    """A checkpoint is damaged, or does not fit what it was asked to be used for."""

    exit_code = 5


class CompileError(EagleError, RuntimeError):
    """What was to be compiled is not, for want of a compiler or because of it; the message says why."""

    exit_code = 6


class Interrupted(KeyboardInterrupt):
    """A run was asked to stop, finished its iteration and saved; the message says where."""

    exit_code = 130


class EagleWarning(UserWarning):
    """What went wrong without ending the command, which prints it as one line."""


def did_you_mean(got: str, known: Iterable[str]) -> str:
    """Return `` Did you mean X?`` for the known name nearest to ``got``, or an empty string."""
    close = difflib.get_close_matches(got, list(known), n=1, cutoff=0.5)
    return f" Did you mean {close[0]}?" if close else ""
