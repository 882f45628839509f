"""How robots fall: when, under which command, to which side, and which joints had nowhere left to go.

This is the first thing to look at when a robot falls: where the same joints are at their stops time and again, the
posture is at fault, and no training mends it (``docs/experiments.md``, 39).
"""

from __future__ import annotations

import statistics
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from torch import Tensor

from eagle_rl.evaluation.protocol import COMMANDS

Direction = Literal["forward", "backward", "left", "right"]

LOOK_BACK_S = 0.5
"""How long before a fall joints are looked at: later ones are thrown about by the fall itself."""
MIN_SHARE = 0.1
"""Share of a robot's falls in which a joint is at its stop, for it to be told."""


@dataclass(frozen=True, kw_only=True)
class Fall:
    """One environment's first fall."""

    time_s: float
    """Since the start of its episode."""
    command: tuple[float, ...]
    """What was commanded [m/s, m/s, rad/s, m, rad]."""
    direction: Direction
    """Where the base leaned most, one control step before."""
    at_stops: tuple[str, ...]
    """Joints at a soft limit or beyond, LOOK_BACK_S before, or at the start of an episode that was shorter."""

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Fall:
        """Read back what ``dataclasses.asdict`` wrote to JSON."""
        return cls(**{**data, "command": tuple(data["command"]), "at_stops": tuple(data["at_stops"])})


class BalancedEnv(Protocol):
    """What is looked at."""

    @property
    def slot_names(self) -> tuple[str, ...]:
        """The joint each of the 32 slots stands for."""

    def balance(self) -> tuple[Tensor, Tensor]:
        """Gravity in the base frame, (N, 3), and which joints are at a soft limit or beyond, bool, (N, 32)."""


class FallWatch:
    """Remembers how each environment stood until it fell for the first time."""

    def __init__(self, env: BalancedEnv, step_dt: float) -> None:
        """Begin with nobody fallen, at steps of ``step_dt`` [s]."""
        self.falls: list[Fall] = []
        self._env, self._step_dt = env, step_dt
        self._recent: deque[tuple[Tensor, Tensor]] = deque(maxlen=max(1, round(LOOK_BACK_S / step_dt)))

    def look(self) -> None:
        """See how everybody stands, before a control step."""
        gravity, at_stop = self._env.balance()
        self._recent.append((gravity.to("cpu", copy=True), at_stop.cpu()))  # the state may be written to

    def note(self, step: int, command: Tensor, fell: Tensor) -> None:
        """Keep the falls of a control step.

        Args:
            step: number of the step in its episode, from 0.
            command: what was commanded, shape (N, 5).
            fell: who fell in it for the first time, bool, shape (N,).
        """
        (gravity, _), (_, at_stop) = self._recent[-1], self._recent[0]
        for i in fell.nonzero().flatten().tolist():
            joints = at_stop[i].nonzero().flatten().tolist()
            fall = Fall(
                time_s=(step + 1) * self._step_dt,
                command=tuple(command[i].tolist()),
                direction=_direction(gravity[i]),
                at_stops=tuple(self._env.slot_names[joint] for joint in joints),
            )
            self.falls.append(fall)


def _direction(gravity: Tensor) -> Direction:
    """Where a base leans most by gravity in its frame, (3,): x is forward and y left."""
    forward, left = gravity[:2].tolist()
    if abs(forward) >= abs(left):
        return "forward" if forward > 0 else "backward"
    return "left" if left > 0 else "right"


def falls_table(falls: Mapping[tuple[str, str], tuple[Sequence[Fall], int]]) -> str:
    """GitHub Markdown, a row for each robot and method that fell; empty where nobody did.

    Args:
        falls: by robot and method: falls, and how many environments there were.
    """
    fallen = {names: (some, count) for names, (some, count) in falls.items() if some}
    if not fallen:
        return ""
    head = ("robot", "method", "falls", "after [s]", "to", "under (v_x, v_y, omega, h, p)", "joints at their stops")
    rows = [(*names, f"{len(some)} of {count}", *_cells(some)) for names, (some, count) in fallen.items()]
    lines = ["| " + " | ".join(row) + " |" for row in (head, ("---",) * len(head), *rows)]
    note = (
        f"Falls: medians of time and of each command; joints at a soft limit or beyond {LOOK_BACK_S:g} s before, "
        f"where that is so in at least {MIN_SHARE:.0%} of a row's falls. Single ones are in the result's JSON."
    )
    return "\n".join([*lines, "", note, ""])


def _cells(falls: Sequence[Fall]) -> tuple[str, ...]:
    """What falls have in common: time, directions, command and joints."""
    medians = [statistics.median(fall.command[d] for fall in falls) for d in range(len(COMMANDS))]
    directions = Counter(fall.direction for fall in falls)
    joints = Counter(joint for fall in falls for joint in fall.at_stops)
    often = Counter({joint: count for joint, count in joints.items() if count >= MIN_SHARE * len(falls)})
    return (
        f"{statistics.median(fall.time_s for fall in falls):.1f}",
        _shares(directions, len(falls)),
        ", ".join(f"{median:+.2f}" for median in medians),
        _shares(often, len(falls)) or "-",
    )


def _shares(counts: Counter[Any], total: int) -> str:
    """The commonest first, with their share of all falls."""
    return ", ".join(f"{name} {count / total:.0%}" for name, count in counts.most_common())
