"""Second looks at a robot that loads: what ``eagle robots check`` reports and ``eagle robots show`` prints."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np

from eagle_rl.config.schema import SimCfg

from .asymmetry import asymmetries
from .consistency import direction_faults, shapeless
from .load import load_robot
from .model import KEYFRAME, build_model
from .sensors import FLOOR
from .slots import HEAD_AND_ARM_SLOTS, SLOT_NAMES
from .spec import COLLISION_LINKS, FALL_LINKS, FEET, Array, RobotSpec
from .tree import Body, Pose, Tree
from .urdf import read_urdf

COLUMNS = ("slot", "joint", "sign", "zero", "default", "lower", "upper", "velocity", "effort", "kp", "kd", "armature")
"""Columns of :func:`describe`: angles native [rad], velocity [rad/s], effort [N m], kp [N m/rad], kd [N m s/rad],
armature [kg m^2]."""

MAX_SOLE_TILT = 0.02
"""Tilt of a sole in the default pose that is reported [rad]."""
MAX_SOLE_GAP = 0.005
"""Distance between sole centre and the foot's lowest shape that is reported [m]."""
MAX_ASYMMETRY = 0.02
"""Left/right difference of a link that is reported, relative."""
MIN_DAMPING_RATIO = 0.05
"""Damping ratio of a joint's PD loop, other joints held, that is reported when below [-]."""


def check_robot(name_or_path: str | Path) -> list[str]:
    """Load a robot and return what is odd about it, one sentence each; an empty list is a clean bill.

    Raises:
        RobotError: if the robot cannot be used at all.
    """
    spec = load_robot(name_or_path)
    tree = read_urdf(spec.urdf_path)
    model = build_model(spec, SimCfg())
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(KEYFRAME).id)
    mujoco.mj_forward(model, data)
    return [
        *direction_faults(spec, tree, HEAD_AND_ARM_SLOTS),
        *_sole_findings(spec, tree),
        *_shape_findings(spec, tree),
        *_contact_findings(model, data),
        *_gain_findings(spec, model, data),
        *(str(item) for item in asymmetries(spec) if item.relative > MAX_ASYMMETRY),
    ]


def describe(spec: RobotSpec) -> list[tuple[str, ...]]:
    """One row per slot, cells as in ``COLUMNS``; a slot the robot lacks has ``-`` in every other cell."""
    joints = {int(slot): index for index, slot in enumerate(spec.slots)}
    numbers = (
        spec.zero_offsets,
        spec.default_joint_pos,
        spec.joint_lower,
        spec.joint_upper,
        spec.velocity_limit,
        spec.effort_limit,
        spec.stiffness,
        spec.damping,
        spec.armature,
    )
    rows: list[tuple[str, ...]] = []
    for slot, name in enumerate(SLOT_NAMES):
        index = joints.get(slot)
        if index is None:
            rows.append((name, *("-" for _ in COLUMNS[1:])))
            continue
        sign = "+" if spec.signs[index] > 0 else "-"
        rows.append((name, spec.joint_names[index], sign, *(f"{column[index]:.4g}" for column in numbers)))
    return rows


def _sole_findings(spec: RobotSpec, tree: Tree) -> list[str]:
    poses = tree.forward(spec.default_joint_pos)
    findings = []
    for side, sole in zip(FEET, spec.sole_offsets, strict=True):
        body = tree.locate(spec.link_roles[f"{side}_foot"])[0]
        tilt = math.acos(min(1.0, float(poses[body.name].rot[2, 2])))
        if tilt > MAX_SOLE_TILT:
            findings.append(f"the {side} sole is tilted by {tilt:.3f} rad in the default pose")
        lowest = _lowest_point(body)
        if abs(lowest - sole[2]) > MAX_SOLE_GAP:
            findings.append(f"the {side} sole centre is at z {sole[2]:g} m, but the foot's shapes reach {lowest:g} m")
    return findings


def _lowest_point(body: Body) -> float:
    """Lowest z of a body's collision shapes in its own frame [m]."""
    return min(_bottom(s.kind, s.size, s.pose) for s in body.shapes if not s.visual)


def _bottom(kind: str, size: tuple[float, ...], pose: Pose) -> float:
    down = np.abs(pose.rot[2])
    if kind == "box":
        return float(pose.pos[2] - down @ np.array(size))
    half_length = size[1] if kind == "capsule" else 0.0
    return float(pose.pos[2] - size[0] - half_length * down[2])


def _shape_findings(spec: RobotSpec, tree: Tree) -> list[str]:
    bodies = {role: tree.locate(spec.link_roles[role])[0] for role in dict.fromkeys((*COLLISION_LINKS, *FALL_LINKS))}
    return [shapeless(body, role, "it can touch nothing") for role, body in bodies.items() if not body.can_touch]


def _contact_findings(model: mujoco.MjModel, data: mujoco.MjData) -> list[str]:
    floor = model.geom(FLOOR).id
    bodies = {
        tuple(sorted((model.body(model.geom_bodyid[a]).name, model.body(model.geom_bodyid[b]).name)))
        for a, b in data.contact.geom
        if floor not in (a, b)
    }
    return [f"{a} and {b} touch in the default pose; exclude the pair or trim a shape" for a, b in sorted(bodies)]


def _gain_findings(spec: RobotSpec, model: mujoco.MjModel, data: mujoco.MjData) -> list[str]:
    inertia = np.diag(mass_matrix(model, data))[6:]
    with np.errstate(divide="ignore"):
        ratio = spec.damping / (2.0 * np.sqrt(spec.stiffness * inertia))
    return [
        f"{name}: kp {kp:g} and kd {kd:g} give a damping ratio of {r:.3f} on {j:.3g} kg m^2, it will ring"
        for name, kp, kd, r, j in zip(spec.joint_names, spec.stiffness, spec.damping, ratio, inertia, strict=True)
        if r < MIN_DAMPING_RATIO
    ]


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Dense joint-space inertia at the present configuration, armature included, shape (nv, nv)."""
    columns = np.zeros((model.nv, model.nv))
    for column, unit in zip(columns, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return columns.T
