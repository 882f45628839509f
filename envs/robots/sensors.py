"""The sensors every robot's model has, in one order, so that ``sensordata`` has one layout for all robots."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from .spec import COLLISION_LINKS, FALL_LINKS, FEET, RobotSpec

FLOOR = "floor"
"""Name of the floor geom."""

SOLE_SITES = tuple(f"{side}_sole" for side in FEET)
IMU_SITE = "imu"

_CONTACT_FORCE = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
_CONTACT_FOUND = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)
_REDUCE_NETFORCE = 3


@dataclass(frozen=True)
class _Block:
    """Consecutive sensors of one kind, one for each owner, with ``dim`` numbers each."""

    name: str
    owners: tuple[str, ...]
    dim: int


_BLOCKS = (
    _Block("sole_pos", FEET, 3),
    _Block("sole_vel", FEET, 3),
    _Block("foot_force", FEET, 3),
    _Block("contact_force", COLLISION_LINKS, 3),
    _Block("floor_contact", FALL_LINKS, 1),
)


def _slices() -> dict[str, slice]:
    out: dict[str, slice] = {}
    start = 0
    for block in _BLOCKS:
        stop = start + len(block.owners) * block.dim
        out[block.name] = slice(start, stop)
        start = stop
    return out


SENSOR_SLICES: dict[str, slice] = _slices()
"""Where each block lies in ``sensordata``; each reshapes to (owners, dim):

- ``sole_pos``, ``sole_vel``: (2, 3) position [m] and velocity [m/s] of the sole centres, world frame, FEET order;
- ``foot_force``: (2, 3) net contact force of the floor on each foot [N], world frame: z is positive in stance;
- ``contact_force``: (7, 3) net contact force of anything on each of COLLISION_LINKS [N], world frame;
- ``floor_contact``: (3,) number of contacts of each of FALL_LINKS with the floor.
"""

NUM_SENSORS: int = SENSOR_SLICES[_BLOCKS[-1].name].stop
"""Length of ``sensordata``."""


def add_sensors(world: mujoco.MjSpec, spec: RobotSpec) -> None:
    """Add every sensor of ``SENSOR_SLICES``; the world needs the floor and the robot's sites."""
    for kind in (mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtSensor.mjSENS_FRAMELINVEL):
        for name in SOLE_SITES:
            world.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=name)
    for side in FEET:
        _add_contact(world, _CONTACT_FORCE, on=spec.link_roles[f"{side}_foot"], floor_only=True)
    for role in COLLISION_LINKS:
        _add_contact(world, _CONTACT_FORCE, on=spec.link_roles[role], floor_only=False)
    for role in FALL_LINKS:
        _add_contact(world, _CONTACT_FOUND, on=spec.link_roles[role], floor_only=True)


def _add_contact(world: mujoco.MjSpec, field: int, *, on: str, floor_only: bool) -> None:
    """Sense what happens to body ``on``: MuJoCo reports the force of the first object on the second."""
    kind, name = (mujoco.mjtObj.mjOBJ_GEOM, FLOOR) if floor_only else (mujoco.mjtObj.mjOBJ_XBODY, "world")
    world.add_sensor(
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=kind,
        objname=name,
        reftype=mujoco.mjtObj.mjOBJ_BODY,
        refname=on,
        intprm=[field, _REDUCE_NETFORCE, 1],
    )
