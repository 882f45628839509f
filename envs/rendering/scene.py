"""The stage: several robots side by side in one MuJoCo model that is only ever looked at, never stepped.

Every robot keeps its own simulation; each frame its ``qpos`` is copied into the stage, moved sideways into its lane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from eagle_rl.config.schema import SimCfg

from ..robots.model import build_spec, set_options
from ..robots.spec import Array, RobotSpec

LANE_WIDTH = 1.25
"""Distance between neighbouring robots [m]."""
MARGIN = 0.7 * LANE_WIDTH
"""From the middle of the outermost robot to the edge of the picture [m]."""

_SKY_TOP, _SKY_BOTTOM = (0.55, 0.70, 0.88), (0.93, 0.96, 0.99)
_TILE_LIGHT, _TILE_DARK = (0.80, 0.83, 0.86), (0.66, 0.71, 0.76)


@dataclass(frozen=True, kw_only=True)
class CameraCfg:
    """Where the picture is taken from: a point that follows the robots' mean position at a constant bearing."""

    azimuth_deg: float = 193.0
    """Viewing direction about z [deg]; 180 looks at the robots' faces, more is from their left."""
    elevation_deg: float = -8.0
    """Viewing direction above the horizon [deg]."""
    margin: float = 1.0
    """Distance as a multiple of the least that shows the whole line [-]."""
    height: float = 0.85
    """Height of the point looked at [m]."""


class Stage:
    """A model of all robots for rendering.

    Attributes:
        model: the compiled model.
        data: its state; ``pose`` writes it.
        names: robot names, in the order of their lanes, from left to right in the picture.
    """

    def __init__(self, specs: Sequence[RobotSpec]) -> None:
        """Put each robot, with the shapes that only show, into its lane in its default pose; no robot twice."""
        self.names = tuple(spec.name for spec in specs)
        self._lanes = lanes(len(specs))
        world, sim = _empty_stage(), SimCfg()
        set_options(world, sim)
        for spec, lane in zip(specs, self._lanes, strict=True):
            frame = world.worldbody.add_frame(pos=[0.0, lane, 0.0])
            frame.attach_body(build_spec(spec, sim, visuals=True).worldbody.first_body(), f"{spec.name}/", "")
        self.model = world.compile()
        self.data = mujoco.MjData(self.model)
        ends = np.cumsum([7 + spec.num_joints for spec in specs]).tolist()
        self._parts = [slice(end - 7 - spec.num_joints, end) for end, spec in zip(ends, specs, strict=True)]
        self.pose([default_qpos(spec) for spec in specs])
        self._label_heights = [self._top(name) + 0.3 for name in self.names]

    def pose(self, qpos: Sequence[Array]) -> None:
        """Show each robot in its own configuration.

        Args:
            qpos: per robot, root position [m], quaternion (w, x, y, z) and joint angles [rad] in native order.
        """
        for part, lane, values in zip(self._parts, self._lanes, qpos, strict=True):
            self.data.qpos[part] = values
            self.data.qpos[part.start + 1] += lane
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        self.model.light_pos[0, :2] = self.root_positions()[:, :2].mean(axis=0)
        mujoco.mj_camlight(self.model, self.data)

    def root_positions(self) -> Array:
        """Where the robots' roots are on the stage [m], shape (num_robots, 3)."""
        return np.array([self.data.qpos[part.start : part.start + 3] for part in self._parts])

    def label_positions(self) -> Array:
        """Points above the robots' heads [m], shape (num_robots, 3)."""
        return np.column_stack([self.root_positions()[:, :2], self._label_heights])

    def _top(self, name: str) -> float:
        """Height of a robot's highest shape [m]."""
        bodies = [i for i in range(self.model.nbody) if self.model.body(i).name.startswith(f"{name}/")]
        return float(self.data.geom_xpos[np.isin(self.model.geom_bodyid, bodies), 2].max())


class FollowCamera:
    """Points a MuJoCo camera at the robots, glides after their middle and steps back when they part."""

    def __init__(
        self, camera: mujoco.MjvCamera, num_robots: int, aspect: float, fovy_deg: float, cfg: CameraCfg | None = None
    ) -> None:
        """Stand back far enough to see ``num_robots`` lanes in a picture of the given aspect ratio."""
        cfg = cfg or CameraCfg()
        self.camera = camera
        camera.azimuth, camera.elevation = cfg.azimuth_deg, cfg.elevation_deg
        self._least = camera.distance = cfg.margin * _distance(num_robots, aspect, fovy_deg)
        azimuth = np.radians(cfg.azimuth_deg)
        self._forward = np.array([np.cos(azimuth), np.sin(azimuth)])
        self._half_width = aspect * float(np.tan(0.5 * np.radians(fovy_deg)))
        self._height = cfg.height
        self._centre: Array | None = None

    def follow(self, roots: Array, smoothing: float = 0.97) -> None:
        """Move towards the mean of the root positions, shape (num_robots, 3) [m]; call once per control step."""
        target = roots[:, :2].mean(axis=0)
        self._centre = target if self._centre is None else smoothing * self._centre + (1 - smoothing) * target
        self.camera.lookat = [*self._centre, self._height]
        needed = max(self._least, self._needed(roots[:, :2] - self._centre))
        self.camera.distance = smoothing * self.camera.distance + (1 - smoothing) * needed

    def _needed(self, offsets: Array) -> float:
        """Distance from which robots with these horizontal offsets from the point looked at are all in view [m]."""
        depth = offsets @ self._forward
        across = np.abs(offsets @ np.array([-self._forward[1], self._forward[0]])) + MARGIN
        return float((across / self._half_width - depth).max())


def default_qpos(spec: RobotSpec) -> Array:
    """A robot's default pose, feet on the ground: root position, quaternion and native joint angles."""
    return np.concatenate([[0.0, 0.0, spec.nominal_height, 1.0, 0.0, 0.0, 0.0], spec.default_joint_pos])


def lanes(num_robots: int) -> Array:
    """Lateral position of each robot's lane [m], the first robot leftmost in the picture, shape (num_robots,)."""
    return LANE_WIDTH * (np.arange(num_robots, dtype=np.float64) - 0.5 * (num_robots - 1))


def _distance(num_robots: int, aspect: float, fovy_deg: float) -> float:
    """Distance at which both the line of robots and a robot's height fit into the view [m]."""
    half_height = np.tan(0.5 * np.radians(fovy_deg))
    across = (0.5 * LANE_WIDTH * (num_robots - 1) + MARGIN) / (half_height * aspect)
    return float(max(across, 1.1 / half_height))


def _empty_stage() -> mujoco.MjSpec:
    """A tiled floor under a pale sky with one soft sun."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 3840, 2160
    spec.visual.global_.fovy = 30.0
    spec.visual.quality.shadowsize = 4096
    spec.visual.quality.offsamples = 4
    spec.visual.quality.numslices, spec.visual.quality.numstacks = 18, 9
    spec.visual.headlight.ambient = [0.42, 0.42, 0.43]
    spec.visual.headlight.diffuse = [0.30, 0.30, 0.30]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.visual.map.shadowclip = 2.5
    spec.visual.rgba.haze = [*_SKY_BOTTOM, 1.0]
    spec.stat.extent = 4.0
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=_SKY_TOP,
        rgb2=_SKY_BOTTOM,
        width=256,
        height=1536,
    )
    _add_floor(spec)
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mode=mujoco.mjtCamLight.mjCAMLIGHT_FIXED,
        pos=[0.0, 0.0, 4.0],
        dir=[-0.35, -0.45, -1.0],
        diffuse=[0.50, 0.49, 0.47],
        specular=[0.15, 0.15, 0.15],
        castshadow=True,
    )
    return spec


def _add_floor(spec: mujoco.MjSpec) -> None:
    """Half-metre tiles, so that steps and slides can be seen."""
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=_TILE_LIGHT,
        rgb2=_TILE_DARK,
        width=256,
        height=256,
    )
    tiles = spec.add_material(name="tiles", texrepeat=[1.0, 1.0], texuniform=True)
    textures = list(tiles.textures)
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    tiles.textures = textures
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.05])
    floor.material = "tiles"
