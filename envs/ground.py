"""The ground under the robots: its height anywhere, and on uneven ground the level each environment has reached."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from .geometry import from_yaw_frame, heading_of
from .recording import Attributes
from .rng import CounterRng
from .sim.height_field import HeightField
from .sim.terrain import Terrain
from .state import PooledState

MAX_START_LEVEL = 3
"""Environments start on levels 0 to 3 (HugWBC 8)."""
MIN_SCORE = 0.8
"""Mean linear-velocity reward over its maximum that goes up a level [-] (HugWBC 8)."""
MIN_PROGRESS = 0.5
"""Share of the commanded distance under which a level is lost [-] (HugWBC 8)."""
UPRIGHT = 0.85
"""Cosine of the tilt under which an episode ended well [-]."""
MARGIN = 1.0
"""Nearest to the end of the world a robot may come [m]."""
_FOOTPRINT = 0.25
"""Robots start above the highest ground within this distance [m]."""


class Plane:
    """Flat ground at height zero, without levels."""

    ATTRIBUTES: ClassVar[Attributes] = ((), ())
    """Paths, from the environment, of what :meth:`judge` reads and writes (``envs.recording``)."""
    has_levels: ClassVar[bool] = False
    """Whether environments move between levels when an episode ends, by :meth:`advance`."""

    def __init__(self, scan_points: Tensor) -> None:
        """Measure at these points of the yaw frame [m], shape (P, 2)."""
        self._scan_points = scan_points

    def measure(self, root_pos: Tensor, root_quat: Tensor, foot_pos: Tensor) -> dict[str, Tensor]:
        """Heights over the ground, as the fields of ``PooledState`` of these names.

        Args:
            root_pos: world [m], shape (n, 3).
            root_quat: (w, x, y, z), shape (n, 4).
            foot_pos: sole centres, world [m], shape (n, 2, 3).
        """
        scan = root_pos.new_zeros(len(root_pos), len(self._scan_points))
        return {"base_height": root_pos[:, 2], "foot_height": foot_pos[..., 2], "height_scan": scan}

    def place(self, ids: Tensor, count: Tensor, root: Tensor) -> Tensor:
        """Move initial root states (n, 13), given about the origin, to where some environments' episodes begin."""
        return root

    def judge(self, score: Tensor, state: PooledState) -> None:
        """Take one step: linear-velocity reward over its maximum, shape (N,), and the state."""

    def advance(self, ids: Tensor, count: Tensor, state: PooledState, length: Tensor) -> None:
        """Move environments whose episode ended up or down a level.

        Args:
            ids: environments, shape (n,).
            count: episodes each began, shape (n,).
            state: of all environments, at the end of the episode.
            length: age of all episodes in control steps, shape (N,).
        """

    def left(self, root_pos: Tensor) -> Tensor:
        """Whether robots reached the end of the world, bool, shape (n,)."""
        return torch.zeros_like(root_pos[:, 0], dtype=torch.bool)

    def log(self, robot_names: Sequence[str]) -> dict[str, Tensor]:
        """Mean level of every robot."""
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """Levels and how the present episodes go."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""


class Surface:
    """Heights of a field anywhere, on the very triangles that MuJoCo collides with."""

    def __init__(self, field: HeightField, like: Tensor) -> None:
        """Hold the heights with the dtype and device of ``like``."""
        self._rows, self._columns = field.heights.shape
        self._cell = field.cell_size
        self._heights = like.new_tensor(field.heights).flatten()
        self._last_corner = like.new_tensor([self._columns - 2, self._rows - 2])
        self.extent = like.new_tensor([self._columns - 1, self._rows - 1]) * (0.5 * field.cell_size)
        """Distance of the edges from the origin along x and y [m], shape (2,)."""

    def height(self, xy: Tensor) -> Tensor:
        """World z of the ground at points of the plane [m], shape (..., 2) -> (...); that of the edge beyond it.

        Each cell is cut along the diagonal through its corners of least and of greatest x and y.
        """
        place = torch.maximum(torch.minimum(xy, self.extent), -self.extent) + self.extent
        place = place / self._cell
        corner = torch.minimum(place.floor(), self._last_corner)
        x, y = (place - corner).unbind(-1)
        column, row = corner.long().unbind(-1)
        first = row * self._columns + column
        second = first + torch.where(x >= y, 1, self._columns)
        low, middle, high = (self._heights[i] for i in (first, second, first + self._columns + 1))
        return low + torch.maximum(x, y) * (middle - low) + torch.minimum(x, y) * (high - middle)


class UnevenGround(Plane):
    """Patches of growing difficulty; robots that walk well meet harder ones (HugWBC 8, without its joint condition)."""

    ATTRIBUTES: ClassVar[Attributes] = (("ground._sums", "ground._steps"), ("ground._sums", "ground._steps"))
    has_levels = True
    _STATE = ("level", "_sums", "_steps")

    def __init__(
        self,
        terrain: Terrain,
        scan_points: Tensor,
        robot_id: Tensor,
        rng: CounterRng,
        step_dt: float,
        episode_steps: int,
    ) -> None:
        """Draw the starting levels.

        Args:
            terrain: the patches.
            scan_points: where to measure, in the yaw frame [m], shape (P, 2); its dtype is that of all heights.
            robot_id: robot of each environment, shape (N,).
            rng: noise of the run.
            step_dt: control step [s].
            episode_steps: control steps of a full episode.
        """
        super().__init__(scan_points)
        self._surface = Surface(terrain.field, scan_points)
        self._scan_offsets = torch.nn.functional.pad(scan_points, (0, 1))
        self._centres = scan_points.new_tensor(terrain.centres)
        self._robot_id, self._rng = robot_id, rng
        self._step_dt, self._episode_steps = step_dt, episode_steps
        self._half_patch = float(terrain.centres[0, 1, 1] - terrain.centres[0, 0, 1]) / 2.0
        zeros = torch.zeros_like(robot_id)
        self.level = self._draw("terrain_start", min(MAX_START_LEVEL + 1, len(self._centres)), zeros)
        """Level of each environment, int64, shape (N,)."""
        self._sums = scan_points.new_zeros(len(robot_id), 3)
        self._steps = torch.zeros_like(robot_id)

    def _draw(self, stream: str, number: int, count: Tensor, ids: Tensor | None = None) -> Tensor:
        """Whole numbers from 0 to ``number - 1``, shape (n,)."""
        return (self._rng.uniform(stream, count, 1, ids).squeeze(1) * number).long()

    def measure(self, root_pos: Tensor, root_quat: Tensor, foot_pos: Tensor) -> dict[str, Tensor]:
        """Heights over the ground under root and soles, and of the ground around relative to that under the root."""
        root = root_pos.unsqueeze(1)
        ahead = from_yaw_frame(heading_of(root_quat).unsqueeze(1), self._scan_offsets.expand(len(root), -1, 3))
        around = root + ahead
        ground = self._surface.height(torch.cat((root, foot_pos, around), dim=1)[..., :2])
        return {
            "base_height": root_pos[:, 2] - ground[:, 0],
            "foot_height": foot_pos[..., 2] - ground[:, 1:3],
            "height_scan": ground[:, 3:] - ground[:, :1],
        }

    def place(self, ids: Tensor, count: Tensor, root: Tensor) -> Tensor:
        """Move initial root states onto a patch of each environment's level, above the highest ground underneath."""
        variant = self._draw("terrain_variant", self._centres.shape[1], count, ids)
        xy = root[:, :2] + self._centres[self.level[ids], variant]
        corners = xy.new_tensor([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]]) * _FOOTPRINT
        ground = self._surface.height(xy.unsqueeze(1) + corners).amax(dim=1, keepdim=True)
        return torch.cat((xy, root[:, 2:3] + ground, root[:, 3:]), dim=1)

    def judge(self, score: Tensor, state: PooledState) -> None:
        """Sum up the score, the commanded distance, and the distance walked in the commanded direction."""
        velocity, command = state.base_lin_vel_b[:, :2], state.command[:, :2]
        speed = torch.linalg.vector_norm(command, dim=1)
        along = torch.linalg.vecdot(velocity, command) / speed.clamp(min=1e-6)
        self._sums = self._sums + torch.stack((score, speed * self._step_dt, along * self._step_dt), dim=1)
        self._steps = self._steps + 1

    def advance(self, ids: Tensor, count: Tensor, state: PooledState, length: Tensor) -> None:
        """Up after half a patch with good tracking, down after less than half of what was asked; from the top anywhere.

        An episode that did not begin at its beginning, when ages are spread at the start of training, is not judged.
        """
        steps, (score, asked, walked) = self._steps[ids], self._sums[ids].unbind(1)
        duration = steps.clamp(min=1)
        asked_in_full = asked / duration * self._episode_steps
        upright = state.projected_gravity_b[ids, 2] < -UPRIGHT
        up = (walked > self._half_patch) & (score / duration > MIN_SCORE) & upright
        down = ~up & (walked < MIN_PROGRESS * asked_in_full) & ~self.left(state.root_pos_w[ids])
        judged = (count > 0) & (steps == length[ids])
        level = self.level[ids]
        moved = (level + up.long() - down.long()).clamp(min=0)
        anywhere = self._draw("terrain_level", len(self._centres), count, ids)
        moved = torch.where(moved < len(self._centres), moved, anywhere)
        self.level = self.level.index_copy(0, ids, torch.where(judged, moved, level))
        self._sums = self._sums.index_fill(0, ids, 0.0)
        self._steps = self._steps.index_fill(0, ids, 0)

    def left(self, root_pos: Tensor) -> Tensor:
        """Whether robots are within ``MARGIN`` of the end of the field, bool, shape (n,)."""
        return (root_pos[:, :2].abs() > self._surface.extent - MARGIN).any(dim=1)

    def log(self, robot_names: Sequence[str]) -> dict[str, Tensor]:
        """Mean level of every robot."""
        counts = torch.bincount(self._robot_id, minlength=len(robot_names))
        means = torch.bincount(self._robot_id, self.level.double(), minlength=len(robot_names)) / counts
        return {f"Curriculum/terrain_level/{name}": mean for name, mean in zip(robot_names, means, strict=True)}

    def state_dict(self) -> dict[str, Tensor]:
        """Levels and how the present episodes go."""
        return {name: getattr(self, name).clone() for name in self._STATE}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name in self._STATE:
            setattr(self, name, state[name].to(getattr(self, name)))


def make_ground(
    terrain: Terrain | None, scan_points: Tensor, robot_id: Tensor, rng: CounterRng, step_dt: float, episode_steps: int
) -> Plane:
    """The ground of a run; see :class:`UnevenGround` for the arguments, ``terrain`` being None for a plane."""
    if terrain is None:
        return Plane(scan_points)
    return UnevenGround(terrain, scan_points, robot_id, rng, step_dt, episode_steps)
