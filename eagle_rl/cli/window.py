"""The window of ``eagle play``: robots in real time, commanded from the keyboard or by a script."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import mujoco
import mujoco.viewer
import numpy as np
from numpy.typing import NDArray

from eagle_rl.config.commands import COMMAND_KEYS, CommandScript
from eagle_rl.config.schema import CommandsCfg
from envs.rendering.offscreen import RenderingError
from envs.rendering.scene import FollowCamera, Stage

from .session import Session, caption

Array = NDArray[np.float64]


class Key(NamedTuple):
    """What a key does to the command."""

    name: str
    column: int
    step: float


KEYS = {
    265: Key("Up", 0, 0.1),
    264: Key("Down", 0, -0.1),
    263: Key("Left", 2, 0.2),
    262: Key("Right", 2, -0.2),
    44: Key(",", 1, 0.1),
    46: Key(".", 1, -0.1),
    266: Key("Page Up", 3, 0.05),
    267: Key("Page Down", 3, -0.05),
    268: Key("Home", 4, -0.1),
    269: Key("End", 4, 0.1),
}
"""GLFW key codes: arrows walk and turn, comma and full stop side-step, the rest squat and lean."""
STOP = 257
"""Enter."""


class Keyboard:
    """A command that keys change, inside the finishing ranges."""

    def __init__(self, ranges: CommandsCfg) -> None:
        """Start standing."""
        bounds = (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_z, ranges.base_height, ranges.body_pitch)
        self.low, self.high = np.array([bound.finishing for bound in bounds]).T
        self.command = np.zeros(len(COMMAND_KEYS))

    def press(self, code: int) -> None:
        """Apply a GLFW key code; other keys do nothing."""
        if code == STOP:
            self.command = np.zeros_like(self.command)
        elif code in KEYS:
            _, column, step = KEYS[code]
            command = self.command.copy()
            command[column] = np.clip(round(command[column] + step, 3), self.low[column], self.high[column])
            self.command = command


def help_text() -> str:
    """The keys in words."""
    keys = ", ".join(f"{key.name} {COMMAND_KEYS[key.column]}{key.step:+g}" for key in KEYS.values())
    return f"{keys}, Enter stands still"


def watch(session: Session, script: CommandScript | None, seconds: float | None) -> None:
    """Show robots until the window is closed.

    Args:
        session: the robots.
        script: what to command, over and over, or None for the keyboard.
        seconds: stop after so long, or None.

    Raises:
        RenderingError: no window can be opened.
    """
    keyboard = Keyboard(session.cfg.task.commands)
    stage = Stage(session.specs)
    if script is None:
        print(help_text())
    with _open_window(stage, keyboard) as viewer:
        fovy = float(stage.model.vis.global_.fovy)
        camera = FollowCamera(viewer.cam, len(session.specs), 16 / 9, fovy)
        start = time.monotonic()
        while viewer.is_running() and (seconds is None or session.time < seconds):
            command = keyboard.command if script is None else script.at(session.time % script.duration)
            session.step(command)
            with viewer.lock():
                stage.pose(session.qpos)
                camera.follow(stage.root_positions())
            viewer.set_texts((None, mujoco.mjtGridPos.mjGRID_TOPLEFT, caption(session.time, command), ""))
            viewer.sync()
            time.sleep(max(0.0, start + session.time - time.monotonic()))


@contextlib.contextmanager
def _open_window(stage: Stage, keyboard: Keyboard) -> Iterator[Any]:
    """MuJoCo's viewer; its thread is waited for, because leaving Python while it draws crashes."""
    others = set(threading.enumerate())
    try:
        viewer = mujoco.viewer.launch_passive(
            stage.model, stage.data, key_callback=keyboard.press, show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:
        raise RenderingError(f"no window can be opened: {error}. Make a video: --video robots.mp4") from error
    try:
        yield viewer
    finally:
        viewer.close()
        for thread in set(threading.enumerate()) - others:
            thread.join(timeout=5.0)
