"""Command scripts: what robots are told to do over time, one format for videos, regression and sim2sim.

A YAML list of ``{t, vx, vy, wz, h, p}``. ``t`` is the time [s] from which the entry holds; what an entry leaves out is
zero. ``vx, vy`` [m/s] and ``wz`` [rad/s] are in the base's heading frame, ``h`` [m] is the offset from the robot's
nominal height, ``p`` [rad] the body pitch, positive forward. Changes are blended over ``BLEND_S``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eagle_rl.errors import ConfigError, did_you_mean
from eagle_rl.paths import shown

from .compose import find_file
from .yaml_file import Node, parse_yaml, read_text

Array = NDArray[np.float64]

COMMAND_KEYS = ("vx", "vy", "wz", "h", "p")
"""Keys of an entry, in the order of the command (v_x, v_y, omega, h, p)."""
BLEND_S = 0.3
"""Time over which one command turns into the next [s]."""
HOLD_S = 2.0
"""How long the last entry is shown [s]."""


@dataclass(frozen=True, eq=False)
class CommandScript:
    """Commands over time."""

    times: Array
    """Start of each entry [s], rising from 0, shape (n,)."""
    commands: Array
    """(v_x, v_y, omega, h, p) [m/s, m/s, rad/s, m, rad] of each entry, shape (n, 5)."""
    blend_s: float = BLEND_S

    @property
    def duration(self) -> float:
        """End of the script [s]: the last entry is held for ``HOLD_S``."""
        return float(self.times[-1]) + HOLD_S

    def at(self, t: float) -> Array:
        """Command in force at time ``t`` [s], shape (5,)."""
        index = max(0, int(np.searchsorted(self.times, t, side="right")) - 1)
        if index == 0:
            return self.commands[0].copy()
        elapsed = t - self.times[index]
        share = min(1.0, elapsed / self.blend_s) if self.blend_s > 0 else 1.0
        return (1.0 - share) * self.commands[index - 1] + share * self.commands[index]


def load_commands(name_or_path: str) -> CommandScript:
    """A script by the name of a file in ``cfg/commands``, or by path.

    Raises:
        ConfigError: lists everything that is wrong with it.
    """
    path = find_file("commands", name_or_path)
    return parse_commands(read_text(path), shown(path))


def parse_commands(text: str, source: str = "commands") -> CommandScript:
    """A script from YAML text; ``source`` names it in messages."""
    entries = parse_yaml(text, source)
    if not isinstance(entries.value, list) or not entries.value:
        raise ConfigError(f"{source}: expected a list of entries such as `- {{t: 0, vx: 0.5}}`.")
    faults: list[str] = []
    rows = [_entry(entry, faults) for entry in entries.items]
    times = np.array([row[0] for row in rows])
    faults += _faults_of_times(times, entries.items)
    if faults:
        raise ConfigError(faults)
    return CommandScript(times, np.array([row[1:] for row in rows]))


def _entry(node: Node, faults: list[str]) -> list[float]:
    """Time and command of an entry; faults are added to the list."""
    if not isinstance(node.value, dict):
        faults.append(f"{node.where}: expected {{t: ..., vx: ..., ...}}, got {node.value!r}.")
        return [math.nan] * (1 + len(COMMAND_KEYS))
    known = ("t", *COMMAND_KEYS)
    faults += [
        f"{value.where}: {key}: no such key.{did_you_mean(key, known)} Known: {', '.join(known)}."
        for key, value in node.children.items()
        if key not in known
    ]
    if "t" not in node.children:
        faults.append(f"{node.where}: t: missing; expected the time [s] from which this entry holds.")
    return [_number(key, node.children[key], faults) if key in node.children else 0.0 for key in known]


def _number(key: str, node: Node, faults: list[str]) -> float:
    value = node.value
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        faults.append(f"{node.where}: {key}: got {value!r}, expected a finite number.")
        return math.nan
    return float(value)


def _faults_of_times(times: Array, nodes: list[Node]) -> list[str]:
    """What is wrong with the order of the entries."""
    faults = []
    if times[0] != 0 and not math.isnan(times[0]):
        faults.append(f"{nodes[0].where}: t: got {times[0]:g}, expected 0 in the first entry.")
    faults += [
        f"{nodes[i].where}: t: got {times[i]:g}, expected at least {times[i - 1] + BLEND_S:g}, "
        f"{BLEND_S:g} s after the entry before."
        for i in range(1, len(times))
        if times[i] - times[i - 1] < BLEND_S - 1e-9
    ]
    return faults
