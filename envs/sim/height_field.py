"""Uneven ground as numbers: the same field serves the physics and the height scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class HeightField:
    """A grid of ground heights, centred on the world's origin.

    Vertex (row, column) lies at x = (column - (columns - 1) / 2) * cell_size and at y = (row - (rows - 1) / 2) *
    cell_size.
    """

    heights: NDArray[np.float64]
    """World z of each vertex [m], shape (rows, columns)."""
    cell_size: float
    """Distance between vertices [m]."""
