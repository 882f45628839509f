"""The browser view of ``eagle play``: robots in real time, commanded by sliders or by a script. Needs viser."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import viser
from numpy.typing import NDArray

from eagle_rl.config.commands import CommandScript
from eagle_rl.config.schema import CommandsCfg
from envs.rendering.scene import Stage

from .session import Session, caption

Array = NDArray[np.float64]

FRAME_STEPS = 2
"""Control steps between pictures: 25 a second."""
_SLIDERS = ("forward [m/s]", "left [m/s]", "turn [rad/s]", "height [m]", "pitch [rad]")
_VISIBLE_GROUPS = 3
"""Geom groups from this on only collide."""


class Sliders:
    """The command as sliders over the finishing ranges."""

    def __init__(self, server: viser.ViserServer, ranges: CommandsCfg) -> None:
        """Start standing."""
        bounds = (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_z, ranges.base_height, ranges.body_pitch)
        self._sliders = [
            server.gui.add_slider(label, *bound.finishing, step=0.05, initial_value=0.0)
            for label, bound in zip(_SLIDERS, bounds, strict=True)
        ]
        server.gui.add_button("stand").on_click(lambda _: self.stand())

    def stand(self) -> None:
        """Put every slider to zero."""
        for slider in self._sliders:
            slider.value = 0.0

    @property
    def command(self) -> Array:
        """What the sliders say, shape (5,)."""
        return np.array([slider.value for slider in self._sliders], dtype=np.float64)


class BrowserScene:
    """A stage in the browser; the world slides under the robots, so that they stay in view."""

    def __init__(self, server: viser.ViserServer, stage: Stage) -> None:
        """Send every shape once; later only bodies move."""
        self._server, self._stage = server, stage
        self._world = server.scene.add_frame("/world", show_axes=False)
        server.scene.add_grid("/world/floor", infinite_grid=True, section_color=(170, 178, 188), plane_opacity=1.0)
        model = stage.model
        shown = [geom for geom in range(model.ngeom) if model.geom_group[geom] < _VISIBLE_GROUPS]
        self._bodies = sorted({int(model.geom_bodyid[geom]) for geom in shown} - {0})
        self._frames = {
            body: server.scene.add_frame(f"/world/{model.body(body).name}", show_axes=False) for body in self._bodies
        }
        for geom in shown:
            if model.geom_bodyid[geom] != 0:
                self._add_geom(geom)
        self._labels = [
            server.scene.add_label(f"/world/names/{name}", name, anchor="bottom-center") for name in stage.names
        ]
        self.update()

    def update(self) -> None:
        """Send the stage's pose."""
        data = self._stage.data
        centre = self._stage.root_positions()[:, :2].mean(axis=0)
        with self._server.atomic():
            self._world.position = (-centre[0], -centre[1], 0.0)
            for body, frame in self._frames.items():
                frame.position, frame.wxyz = data.xpos[body].copy(), data.xquat[body].copy()
            for label, position in zip(self._labels, self._stage.label_positions(), strict=True):
                label.position = position

    def _add_geom(self, geom: int) -> None:
        model, scene = self._stage.model, self._server.scene
        name = f"/world/{model.body(model.geom_bodyid[geom]).name}/{geom}"
        size = model.geom_size[geom]
        place: dict[str, Any] = {"position": model.geom_pos[geom].copy(), "wxyz": model.geom_quat[geom].copy()}
        place["color"] = tuple(int(255 * c) for c in model.geom_rgba[geom, :3])
        kind = mujoco.mjtGeom(model.geom_type[geom])
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            scene.add_box(name, dimensions=tuple(2.0 * size), **place)
        elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            scene.add_icosphere(name, radius=size[0], **place)
        elif kind == mujoco.mjtGeom.mjGEOM_MESH:
            scene.add_mesh_simple(name, *self._mesh(geom), **place)
        else:
            scene.add_cylinder(name, radius=size[0], height=2.0 * size[1], **place)
            for end in (-size[1], size[1]):
                ball = f"{name}/{'top' if end > 0 else 'bottom'}"
                scene.add_icosphere(ball, radius=size[0], color=place["color"], position=(0.0, 0.0, end))

    def _mesh(self, geom: int) -> tuple[Array, NDArray[np.int32]]:
        """Vertices [m] and faces of a mesh geom."""
        model, mesh = self._stage.model, int(self._stage.model.geom_dataid[geom])
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        return model.mesh_vert[first : first + count], model.mesh_face[face : face + faces]


def serve(session: Session, script: CommandScript | None, seconds: float | None) -> None:
    """Show robots to any browser that connects, until interrupted.

    Args:
        session: the robots.
        script: what to command, over and over, or None for the sliders.
        seconds: stop after so long, or None.
    """
    server = viser.ViserServer(verbose=False)
    print(f"http://localhost:{server.get_port()}   Ctrl-C ends it")
    camera = server.initial_camera
    camera.position, camera.look_at, camera.fov = (7.5, 1.7, 1.8), (0.0, 0.0, 0.8), 0.7
    stage = Stage(session.specs)
    scene = BrowserScene(server, stage)
    command_at = _command_source(server, session, script)
    start = time.monotonic()
    with contextlib.ExitStack() as stack:
        stack.callback(server.stop)
        stack.enter_context(contextlib.suppress(KeyboardInterrupt))
        while seconds is None or session.time < seconds:
            session.step(command_at())
            if session.num_steps % FRAME_STEPS == 0:
                stage.pose(session.qpos)
                scene.update()
            time.sleep(max(0.0, start + session.time - time.monotonic()))


def _command_source(server: viser.ViserServer, session: Session, script: CommandScript | None) -> Callable[[], Array]:
    """What to command now: the sliders, or the script, which is then shown."""
    if script is None:
        sliders = Sliders(server, session.cfg.task.commands)
        return lambda: sliders.command
    text = server.gui.add_markdown("")

    def follow() -> Array:
        command = script.at(session.time % script.duration)
        text.content = caption(session.time, command)
        return command

    return follow
