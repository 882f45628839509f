"""A squat and a lean of every robot as pictures, seen from the side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from eagle_rl.config.commands import CommandScript, load_commands
from eagle_rl.config.validate import CONTROL_STEP
from envs.rendering.offscreen import Frame, OffscreenRenderer
from envs.rendering.recorder import evenly
from envs.rendering.scene import CameraCfg, Stage

from .policy import Policy
from .session import Session

POSTURES = {"squat": (3, "m"), "lean": (4, "rad")}
"""Command script of each posture, the column of the command it asks for, and that one's unit."""
PICTURES = 6
SIZE = (300, 360)
FROM_THE_SIDE = CameraCfg(azimuth_deg=105.0, elevation_deg=-6.0, height=0.95)

Strip = list[tuple[Frame, str]]
"""Pictures over time with what is commanded and measured in each."""


def strips(policy: Policy, robots: Sequence[str], posture: str) -> dict[str, Strip]:
    """Each robot by itself, under the command script of a posture."""
    script = load_commands(posture)
    return {robot: _strip(policy, robot, script, *POSTURES[posture]) for robot in robots}


def _strip(policy: Policy, robot: str, script: CommandScript, column: int, unit: str) -> Strip:
    """One robot's pictures."""
    steps = round(script.duration / CONTROL_STEP)
    session = Session(policy.act, policy.cfg, [robot], num_steps=steps)
    picks, strip = set(evenly(steps, PICTURES)), []
    with OffscreenRenderer(Stage(session.specs), *SIZE, FROM_THE_SIDE) as renderer:
        for step in range(steps):
            command = script.at(session.time)
            session.step(command)
            renderer.show(session.qpos)
            if step in picks:
                strip.append((renderer.frame(), _text(session, command, column, unit)))
    return strip


def _text(session: Session, command: NDArray[np.float64], column: int, unit: str) -> str:
    """Time, command and measurement; or when the robot fell."""
    fallen = [time for times in session.falls.values() for time in times]
    if fallen:
        return f"{session.time:.1f} s: fell at {fallen[0]:.1f} s"
    asked, done = (round(values[column], 2) + 0.0 for values in (command, session.measured[0]))  # -0.0 + 0.0 is 0.0
    return f"{session.time:.1f} s: {asked:+.2f}, is {done:+.2f} {unit}"
