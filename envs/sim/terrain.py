"""Uneven ground in patches: levels of growing difficulty along x, variants of each level along y (HugWBC 8).

Slopes and steps are flat in the middle, where robots start, and level with their neighbours at the edge. Rough ground
is rough everywhere, and grows in height at the seam between two levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from eagle_rl.config.schema import TerrainCfg
from eagle_rl.errors import ConfigError

from ..rng import CounterRng
from ..robots.spec import Array
from .height_field import HeightField

NUM_VARIANTS = 8
"""Patches of each level."""
BORDER = 4.0
"""Flat ground around all patches [m]."""
PLATFORM = 1.5
"""Half side of the flat middle of a patch [m]; robots start within 1 m of its centre."""
NOISE_SIZE = 0.2
"""Distance between independent heights of rough ground, linear in between [m] (HugWBC 8)."""
STEP_WIDTH = 0.4
"""[m]; a riser is as wide as a cell of the height field."""
_MAX_VERTICES = 16_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """The ground of a run."""

    field: HeightField
    centres: Array
    """Middle of each patch [m], shape (levels, variants, 2)."""


def build_terrain(cfg: TerrainCfg, seed: int) -> Terrain | None:
    """Lay out the patches; None for a plane.

    Raises:
        ConfigError: patches too small to start on, or too many of them.
    """
    if cfg.kind == "plane":
        return None
    cells = round(cfg.patch_size / cfg.cell_size)
    columns, rows = _Axis.of(cfg, cells, cfg.num_levels), _Axis.of(cfg, cells, NUM_VARIANTS)
    _require_sensible(cfg, len(columns.x) * len(rows.x))
    inside = (columns.patch >= 0)[None, :] & (rows.patch >= 0)[:, None]
    hardest = max(cfg.num_levels - 1, 1)
    difficulty = np.where(inside, np.minimum(columns.patch + (cfg.num_levels == 1), hardest) / hardest, 0.0)
    heights = _shape(cfg, difficulty, columns, rows, seed)
    centres = np.stack(np.meshgrid(columns.middles, rows.middles, indexing="ij"), axis=-1)
    return Terrain(field=HeightField(heights=heights, cell_size=cfg.cell_size), centres=centres)


@dataclass(frozen=True)
class _Axis:
    """Vertices of the field along one axis."""

    x: Array
    """Coordinate of each vertex [m]."""
    patch: Array
    """Index of the patch it lies in, -1 in the border."""
    to_edge: Array
    """Distance from the edge of that patch [m]."""
    middles: Array
    """Middle of each patch [m]."""

    @staticmethod
    def of(cfg: TerrainCfg, cells: int, patches: int) -> _Axis:
        """Lay ``patches`` of so many cells side by side, centred on zero, with the border around them."""
        count = patches * cells + 2 * round(BORDER / cfg.cell_size)
        vertex = np.arange(count + 1, dtype=np.float64) - 0.5 * count
        patch = np.floor(vertex / cells + 0.5 * patches)
        middle = (np.arange(patches, dtype=np.float64) - 0.5 * (patches - 1)) * cells
        inside = (patch >= 0) & (patch < patches)
        nearest = middle[np.clip(patch, 0, patches - 1).astype(np.int64)]
        to_edge = np.where(inside, 0.5 * cells - np.abs(vertex - nearest), 0.0)
        size = cfg.cell_size
        return _Axis(vertex * size, np.where(inside, patch, -1.0), to_edge * size, middle * size)


def _shape(cfg: TerrainCfg, difficulty: Array, columns: _Axis, rows: _Axis, seed: int) -> Array:
    """Heights of all vertices [m] from the difficulty of each in [0, 1], shape (rows, columns)."""
    if cfg.kind == "rough":
        return cfg.roughness * difficulty * _noise(columns.x, rows.x, seed)
    to_edge = np.minimum(columns.to_edge[None, :], rows.to_edge[:, None])
    inward = np.minimum(to_edge, 0.5 * cfg.patch_size - PLATFORM)
    up_or_down = np.where(rows.patch % 2 == 0, 1.0, -1.0)[:, None]
    if cfg.kind == "slopes":
        return up_or_down * np.tan(cfg.slope * difficulty) * inward
    return up_or_down * cfg.step_height * difficulty * np.floor(inward / STEP_WIDTH + 1e-6)


def _require_sensible(cfg: TerrainCfg, vertices: int) -> None:
    least = 2 * PLATFORM + 1.0
    if cfg.patch_size < least:
        raise ConfigError(f"task.terrain.patch_size: got {cfg.patch_size}, expected at least {least} m to start on.")
    if vertices > _MAX_VERTICES:
        raise ConfigError(
            f"task.terrain: {cfg.num_levels} levels of {cfg.patch_size} m with cells of {cfg.cell_size} m make "
            f"{vertices} heights, expected at most {_MAX_VERTICES}. Use fewer levels or larger cells."
        )


def _noise(x: Array, y: Array, seed: int) -> Array:
    """Uniform in [-1, 1] every ``NOISE_SIZE``, linear in between, shape (len(y), len(x))."""
    knots = [np.arange(axis[0], axis[-1] + NOISE_SIZE, NOISE_SIZE) for axis in (y, x)]
    shape = tuple(len(axis) for axis in knots)
    zero = torch.zeros(1, dtype=torch.int64)
    draws = CounterRng(seed, ["terrain"], zero).uniform("height", zero, shape[0] * shape[1])
    coarse = 2.0 * draws.double().numpy().reshape(shape) - 1.0
    rows = np.stack([np.interp(x, knots[1], row) for row in coarse])
    return np.stack([np.interp(y, knots[0], column) for column in rows.T], axis=1)
