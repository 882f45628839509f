"""How a leg's joints take its foot ahead, aside and round, in every posture a robot may walk in."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio

from .embodiment import pinocchio_model
from .posture import HEIGHTS, PITCHES, POSTURE_SLOTS, posture_table
from .slots import MIRROR_SIGN, SLOT_INDEX
from .spec import FEET, Array, RobotSpec

LEG_JOINTS = ("hip_pitch", "hip_roll", "hip_yaw", "knee_pitch", "ankle_pitch", "ankle_roll")
LEG_SLOTS = tuple(tuple(SLOT_INDEX[f"{side}_{joint}"] for joint in LEG_JOINTS) for side in FEET)
"""Slots of a leg's joints, (2, 6); some robots lack some."""
DIRECTIONS = 3
"""Ahead [m], aside [m], and round the vertical through the base [rad]."""

_MIRROR = np.outer([1.0, -1.0, -1.0], MIRROR_SIGN[list(LEG_SLOTS[0])])
"""Sign of each direction times that of each joint: what the left leg's offsets are to the right one's."""
_WEIGHTS = np.array([1.0, 1.0, 1.0, 0.05, 0.3, 0.3])
"""Of a foot's place [1/m] and of its roll, pitch and yaw [1/rad]: who cannot roll the ankle rolls the sole."""
_DAMPING = 1e-5
"""Keeps angles small where a leg is nearly straight."""


def leg_joints(spec: RobotSpec) -> tuple[list[int], tuple[tuple[int, ...], tuple[int, ...]]]:
    """Which of ``LEG_JOINTS`` a robot has, and the native index of each on the left and the right leg."""
    joints = spec.slots.tolist()
    present = [i for i, slot in enumerate(LEG_SLOTS[0]) if slot in joints]
    left, right = (tuple(joints.index(side[i]) for i in present) for side in LEG_SLOTS)
    return present, (left, right)


def bend_table(spec: RobotSpec) -> Array:
    """:func:`posture_table` over ``LEG_JOINTS``, shape (heights, pitches, 6) [rad]."""
    table = posture_table(spec)
    bends = np.zeros((*table.shape[:2], len(LEG_JOINTS)))
    bends[..., [LEG_SLOTS[0].index(slot) for slot in POSTURE_SLOTS[0]]] = table
    return bends


@cache
def stride_table(spec: RobotSpec) -> Array:
    """Canonical offsets of ``LEG_JOINTS`` per unit of each direction, (2, heights, pitches, 3, 6) [rad/m, rad/rad].

    At each node of :func:`posture_table` they move the sole that way, in the yaw frame of the base, and leave its
    height and tilt alone: the pseudo-inverse of the foot's Jacobian.
    """
    model = pinocchio_model(spec)
    data = model.createData()
    columns = np.array([model.joints[model.getJointId(name)].idx_q for name in spec.joint_names])
    velocities = [model.joints[model.getJointId(name)].idx_v for name in spec.joint_names]
    bends, (present, legs) = bend_table(spec), leg_joints(spec)
    table = np.zeros((2, len(HEIGHTS), len(PITCHES), DIRECTIONS, len(LEG_JOINTS)))
    for row, column in np.ndindex(len(HEIGHTS), len(PITCHES)):
        pitch = PITCHES[column]
        angles = spec.default_joint_pos.copy()
        for index in map(list, legs):
            angles[index] += spec.signs[index] * bends[row, column, present]
        q = pinocchio.neutral(model)
        q[3:7] = (0.0, np.sin(pitch / 2), 0.0, np.cos(pitch / 2))
        q[columns] = angles
        pinocchio.computeJointJacobians(model, data, q)
        pinocchio.updateFramePlacements(model, data)
        for foot, (side, index) in enumerate(zip(FEET, map(list, legs), strict=True)):
            frame = model.getFrameId(spec.link_roles[f"{side}_foot"], pinocchio.FrameType.BODY)
            jacobian = pinocchio.getFrameJacobian(model, data, frame, pinocchio.LOCAL_WORLD_ALIGNED)
            jacobian = jacobian[:, [velocities[i] for i in index]] * spec.signs[index]
            place = data.oMf[frame]
            sole = place.rotation @ spec.sole_offsets[foot]
            jacobian[:3] += np.cross(jacobian[3:].T, sole).T
            table[foot, row, column][:, present] = _solve(jacobian, place.translation + sole)
    left = 0.5 * (table[0] + _MIRROR * table[1])  # the vendors' numbers differ a little between left and right
    return np.stack([left, _MIRROR * left])


def _solve(jacobian: Array, sole: Array) -> Array:
    """Joint angles (3, n) for a unit of each direction, given the sole's Jacobian (6, n) and its place (3,)."""
    wanted = np.zeros((6, DIRECTIONS))
    wanted[0, 0] = wanted[1, 1] = wanted[5, 2] = 1.0
    wanted[:2, 2] = -sole[1], sole[0]
    weighted = _WEIGHTS[:, None] * jacobian
    gram = weighted.T @ weighted + _DAMPING * np.eye(jacobian.shape[1])
    return np.asarray(np.linalg.solve(gram, weighted.T @ (_WEIGHTS[:, None] * wanted)).T)
