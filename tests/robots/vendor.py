"""The vendors' numbers, taken once from their URDFs with Pinocchio: ``tests/data/robots/*.json``.

``bodies``: per body after merging fixed links, mass, centre of mass and inertia xx, yy, zz, xy, xz, yz about it.
``joints``: lower, upper, effort, velocity. ``poses``: per pose and per link of ``links``, the link's origin and the
points half a metre along its x and y axes, in the base frame.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from envs.robots.load import load_robot
from envs.robots.spec import Array, RobotSpec

ROBOTS = ("h1", "g1", "t1", "n1", "adam")
DATA = Path(__file__).parents[1] / "data" / "robots"

_PRIMES = [n for n in range(2, 110) if all(n % k for k in range(2, n))]


@cache
def shipped(name: str) -> RobotSpec:
    """A shipped robot, loaded once."""
    return load_robot(name)


def vendor_numbers(name: str) -> dict[str, Any]:
    """Read one robot's file."""
    return dict(json.loads((DATA / f"{name}.json").read_text(encoding="utf-8")))


def vendor_joint_pos(numbers: dict[str, Any], pose: int) -> Array:
    """Joint angles of one of the hundred poses [rad]: a low-discrepancy sequence over the whole range."""
    lower, upper = np.array([row[:2] for row in numbers["joints"].values()]).T
    roots = np.sqrt(np.array(_PRIMES[: len(lower)], dtype=float))
    return np.asarray(lower + (upper - lower) * ((pose + 1) * roots % 1.0))
