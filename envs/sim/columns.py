"""Where the blocks of the pool's rows lie."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate

from ..robots.slots import NUM_SLOTS

JOINT_BLOCKS = ("joint_pos", "joint_vel", "joint_torque")
_ROOT_BLOCKS = {"root_pos": 3, "root_quat": 4, "root_lin_vel_w": 3, "base_ang_vel_b": 3}


def consecutive(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Columns of blocks one after another, by name, from the number of columns of each."""
    stops = accumulate(sizes.values())
    return {name: slice(stop - size, stop) for (name, size), stop in zip(sizes.items(), stops, strict=True)}


def staging_columns(num_sensors: int) -> dict[str, slice]:
    """Columns of the staging array: root, joint position, velocity and torque in slots, then the sensors."""
    return consecutive(_ROOT_BLOCKS | dict.fromkeys(JOINT_BLOCKS, NUM_SLOTS) | {"sensors": num_sensors})
