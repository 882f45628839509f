"""A small, exactly symmetric biped written to disk: a robot whose every number is known in closed form."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import yaml

BOXES = {  # mass [kg], full size [m], centre [m]
    "pelvis": (4.0, (0.1, 0.2, 0.1), (0.0, 0.0, 0.0)),
    "torso": (10.0, (0.2, 0.3, 0.4), (0.0, 0.0, 0.25)),
    "thigh": (3.0, (0.1, 0.1, 0.3), (0.0, 0.0, -0.2)),
    "shank": (2.0, (0.08, 0.08, 0.3), (0.0, 0.0, -0.2)),
    "foot": (0.8, (0.2, 0.08, 0.04), (0.03, 0.0, -0.04)),
    "arm": (1.5, (0.06, 0.06, 0.3), (0.0, 0.0, -0.15)),
    "forearm": (1.0, (0.05, 0.05, 0.24), (0.0, 0.0, -0.12)),
}
JOINTS = {  # child: joint, parent, origin [m] (y for the left side), axis, lower, upper [rad]
    "thigh": ("hip_pitch", "pelvis", (0.0, 0.1, -0.05), (0, 1, 0), -2.0, 2.0),
    "shank": ("knee_pitch", "thigh", (0.0, 0.0, -0.4), (0, 1, 0), -0.1, 2.0),
    "foot": ("ankle_pitch", "shank", (0.0, 0.0, -0.4), (0, 1, 0), -1.0, 1.0),
    "arm": ("shoulder_pitch", "torso", (0.0, 0.2, 0.4), (0, 1, 0), -3.0, 3.0),
    "forearm": ("elbow_pitch", "arm", (0.0, 0.0, -0.3), (0, 1, 0), -2.5, 0.1),
}
EFFORT, VELOCITY = 100.0, 20.0
SOLE_Z = -0.06
NOMINAL_HEIGHT = 0.05 + 0.4 + 0.4 - SOLE_Z


def box_moments(mass: float, size: tuple[float, float, float]) -> tuple[float, float, float]:
    """Moments of inertia of a solid box about its centre [kg m^2]."""
    x, y, z = (side * side for side in size)
    return mass * (y + z) / 12.0, mass * (x + z) / 12.0, mass * (x + y) / 12.0


def _link(name: str) -> str:
    mass, size, centre = BOXES[name.rpartition("_")[2]]
    ixx, iyy, izz = box_moments(mass, size)
    origin = f'<origin xyz="{" ".join(map(str, centre))}"/>'
    return (
        f'<link name="{name}"><inertial>{origin}<mass value="{mass}"/>'
        f'<inertia ixx="{ixx!r}" iyy="{iyy!r}" izz="{izz!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
        f'<collision>{origin}<geometry><box size="{" ".join(map(str, size))}"/></geometry></collision></link>'
    )


def _joint(name: str, parent: str, child: str, origin: tuple[float, ...], axis: tuple[int, ...], limits: Any) -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{" ".join(map(str, origin))}"/><axis xyz="{" ".join(map(str, axis))}"/>'
        f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="{EFFORT}" velocity="{VELOCITY}"/></joint>'
    )


def biped_urdf() -> str:
    """URDF of the biped: one waist yaw, three pitch joints a leg, two an arm, and an imu fixed to the torso."""
    parts = [_link("pelvis"), _link("torso"), '<link name="imu"/>']
    parts.append(_joint("waist_yaw", "pelvis", "torso", (0, 0, 0.05), (0, 0, 1), (-1.5, 1.5)))
    parts.append(
        '<joint name="imu_joint" type="fixed"><parent link="torso"/><child link="imu"/><origin xyz="0 0 0.3"/></joint>'
    )
    for side, sign in (("left", 1), ("right", -1)):
        for child, (joint, parent, (x, y, z), axis, *limits) in JOINTS.items():
            owner = parent if parent in ("pelvis", "torso") else f"{side}_{parent}"
            parts.append(_link(f"{side}_{child}"))
            parts.append(_joint(f"{side}_{joint}", owner, f"{side}_{child}", (x, sign * y, z), axis, limits))
    return '<robot name="biped">' + "\n".join(parts) + "</robot>"


def biped_data() -> dict[str, Any]:
    """What the biped's YAML says, as a fresh dictionary."""
    slots = ["waist_yaw", *(f"{side}_{row[0]}" for side in ("left", "right") for row in JOINTS.values())]
    entry = {
        "sign": 1,
        "zero_offset_rad": 0.0,
        "default_angle_rad": 0.0,
        "stiffness_nm_per_rad": 100.0,
        "damping_nms_per_rad": 5.0,
        "armature_kgm2": 0.02,
    }
    sides = {
        f"{side}_{role}": f"{side}_{link}"
        for side in ("left", "right")
        for role, link in (
            ("foot", "foot"),
            ("hand", "forearm"),
            ("elbow", "forearm"),
            ("hip", "thigh"),
            ("knee", "shank"),
        )
    }
    return {
        "name": "biped",
        "title": "Test biped",
        "urdf": "biped.urdf",
        "base_link": "pelvis",
        "roles": {"torso": "torso", "pelvis": "pelvis", "head": "imu", **sides},
        "sole_centre_m": {"left": [0.03, 0.0, SOLE_Z], "right": [0.03, 0.0, SOLE_Z]},
        "nominal_height_m": NOMINAL_HEIGHT,
        "swing_height_m": 0.14,
        "imu": {"link": "imu", "offset_m": [0.0, 0.0, 0.0]},
        "collision_excludes": [["torso", "left_thigh"]],
        "joints": {slot: {"slot": slot, **deepcopy(entry)} for slot in slots},
    }


def write_biped(folder: Path, urdf: str | None = None, data: object = None) -> Path:
    """Write URDF and YAML into ``folder`` and return the YAML's path."""
    (folder / "biped.urdf").write_text(biped_urdf() if urdf is None else urdf, encoding="utf-8")
    path = folder / "biped.yaml"
    path.write_text(yaml.safe_dump(biped_data() if data is None else data, sort_keys=False), encoding="utf-8")
    return path
