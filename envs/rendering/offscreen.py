"""Frames without a display: an OpenGL context from EGL or OSMesa, whichever the machine has."""

from __future__ import annotations

import ctypes.util
import os
from collections.abc import Sequence
from types import TracebackType
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from eagle_rl.errors import EagleError

from ..robots.spec import Array
from .scene import CameraCfg, FollowCamera, Stage

Frame = NDArray[np.uint8]

_LABEL_RGBA = np.array([0.15, 0.2, 0.28, 1.0], np.float32)

_HELP = (
    "Pictures need OpenGL without a display, which does not work here (tried: {tried}). Install EGL or OSMesa, "
    "for example `apt-get install libegl1 libgl1-mesa-dri` (or `libosmesa6`)."
)


class RenderingError(EagleError, RuntimeError):
    """This machine cannot draw."""


class _Context(Protocol):
    """What MuJoCo's GL contexts have in common."""

    def make_current(self) -> None: ...

    def free(self) -> None: ...


def gl_backends() -> tuple[str, ...]:
    """Backends worth trying: the one ``MUJOCO_GL`` names, otherwise those whose library is installed."""
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    if chosen in ("egl", "osmesa"):
        return (chosen,)
    libraries = {"egl": "EGL", "osmesa": "OSMesa"}
    return tuple(backend for backend, library in libraries.items() if ctypes.util.find_library(library))


def open_context(width: int, height: int) -> _Context:
    """An offscreen OpenGL context.

    Raises:
        RenderingError: no backend works; the message says what to install.
    """
    contexts = (_open_backend(backend, width, height) for backend in gl_backends())
    context = next((found for found in contexts if found is not None), None)
    if context is None:
        raise RenderingError(_HELP.format(tried=", ".join(gl_backends()) or "nothing, neither is installed"))
    return context


def _open_backend(backend: str, width: int, height: int) -> _Context | None:
    """A context of one backend, or None if its driver does not work."""
    try:
        if backend == "egl":
            from mujoco.egl import GLContext
        else:
            from mujoco.osmesa import GLContext
        return GLContext(width, height)
    except (ImportError, AttributeError, RuntimeError, OSError):
        return None


class OffscreenRenderer:
    """Draws a stage into arrays. Use as a context manager."""

    def __init__(self, stage: Stage, width: int = 1280, height: int = 720, camera: CameraCfg | None = None) -> None:
        """Open a context for pictures of ``width`` x ``height`` pixels."""
        self.stage = stage
        self.width, self.height = width, height
        fovy = float(stage.model.vis.global_.fovy)
        self.camera = FollowCamera(mujoco.MjvCamera(), len(stage.names), width / height, fovy, camera)
        self._context = open_context(width, height)
        self._context.make_current()
        self._scene = mujoco.MjvScene(stage.model, maxgeom=4000)
        self._option = mujoco.MjvOption()
        self._gl = mujoco.MjrContext(stage.model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._gl)

    def __enter__(self) -> Self:
        """The renderer itself."""
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """Free the context."""
        self._gl.free()
        self._context.free()

    def show(self, qpos: Sequence[Array]) -> None:
        """Pose the robots, see :meth:`Stage.pose`, and let the camera glide on."""
        self.stage.pose(qpos)
        self.camera.follow(self.stage.root_positions())

    def frame(self) -> Frame:
        """A picture of what is shown, RGB, shape (height, width, 3)."""
        self._context.make_current()
        mujoco.mjv_updateScene(
            self.stage.model,
            self.stage.data,
            self._option,
            None,
            self.camera.camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        self._add_labels()
        rect = mujoco.MjrRect(0, 0, self.width, self.height)
        mujoco.mjr_render(rect, self._scene, self._gl)
        pixels = np.empty((self.height, self.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, rect, self._gl)
        return np.flipud(pixels)

    def _add_labels(self) -> None:
        """Write each robot's name above its head."""
        for name, position in zip(self.stage.names, self.stage.label_positions(), strict=True):
            label = self._scene.geoms[self._scene.ngeom]
            mujoco.mjv_initGeom(
                label, mujoco.mjtGeom.mjGEOM_LABEL, np.full(3, 0.1), position, np.eye(3).ravel(), _LABEL_RGBA
            )
            label.label = name
            self._scene.ngeom += 1
