"""``eagle play --replay-fault``: the last states of an environment that went wrong, in numbers and in pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eagle_rl.errors import ConfigError
from envs.rendering.offscreen import Frame, OffscreenRenderer
from envs.rendering.recorder import captioned, contact_sheet, save_picture, video_writer
from envs.rendering.scene import Stage
from envs.robots.load import load_robot
from envs.sim.fault import Fault, load_fault

FPS = 4.0
"""Control steps a second in a video of a fault: slow enough to see."""


def replay(path: Path, video: Path | None, sheet: Path | None, size: tuple[int, int]) -> None:
    """Print a fault file's states and draw them.

    Args:
        path: file of a run's ``faults`` folder.
        video: where to write a slow video, or None.
        sheet: where to write all states as one picture, or None.
        size: width and height of the pictures [pixel].
    """
    fault = load_fault(path)
    spec = load_robot(fault.robot_file)
    if fault.qpos.shape[1] != 7 + spec.num_joints or fault.qvel.shape[1] != 6 + spec.num_joints:
        raise ConfigError(
            f"{path}: its states have other sizes than {spec.name}'s, whose files must have changed since."
        )
    print(f"{fault.robot}, environment {fault.env}: {fault.cause}")
    for row in range(len(fault.time)):
        print(describe(fault, row, spec.joint_names))
    drawn = [row for row in range(len(fault.time)) if np.isfinite(fault.qpos[row]).all()]
    if not drawn or (video is None and sheet is None):
        return
    with OffscreenRenderer(Stage([spec]), *size) as renderer:
        frames = [_picture(renderer, fault, row) for row in drawn]
    if video is not None:
        with video_writer(video, *size, FPS) as write:
            for frame in frames:
                write(frame)
    if sheet is not None:
        save_picture(sheet, contact_sheet(frames))
    for file in (video, sheet):
        if file is not None:
            print(file)


def describe(fault: Fault, row: int, joints: tuple[str, ...]) -> str:
    """One state in words: when, where, and which joint is fastest."""
    state = np.concatenate([fault.qpos[row], fault.qvel[row]])
    if not np.isfinite(state).all():
        return f"{fault.time[row]:7.2f} s  {np.count_nonzero(~np.isfinite(state))} numbers are not finite"
    speeds = np.abs(fault.qvel[row, 6:])
    fastest = int(speeds.argmax())
    base = f"base {fault.qpos[row, 2]:6.3f} m high, {np.linalg.norm(fault.qvel[row, :3]):7.2f} m/s"
    return f"{fault.time[row]:7.2f} s  {base}, fastest joint {joints[fastest]} {speeds[fastest]:.1f} rad/s"


def _picture(renderer: OffscreenRenderer, fault: Fault, row: int) -> Frame:
    renderer.show([fault.qpos[row]])
    return captioned(renderer.frame(), f"{fault.robot}   {fault.cause}   {fault.time[row]:.2f} s")
