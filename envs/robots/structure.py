"""The structural part of the extended descriptor: limb lengths, joint axes and tree structure of one robot."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .slots import MIRROR_PERMUTATION, MIRROR_SIGN, NUM_SLOTS, SLOT_INDEX
from .spec import FEET, Array, RobotSpec
from .tree import Pose, Tree
from .urdf import read_urdf

LIMBS = ("thigh", "shank", "foot", "upper_arm", "forearm")
"""Hip pitch to knee, knee to ankle pitch, ankle pitch to sole, shoulder pitch to elbow, elbow to the hand's far end."""

STRUCTURE_DIM = len(LIMBS) + 5 * NUM_SLOTS
"""Length of :func:`structure_vector`."""

_LIMB_MEAN, _LIMB_STD = np.array([0.36, 0.32, 0.06, 0.24, 0.25]), np.array([0.08, 0.05, 0.02, 0.05, 0.05])
"""Centre and spread of the limb lengths [m], rounded from the five shipped robots."""
_DEPTH_SCALE = 8.0
"""Joints from the base to the last of the longest chain, about."""


def structure_vector(spec: RobotSpec) -> Array:
    """Describe a robot's build, shape (165,), already scaled to about one.

    In order: limb lengths (5), which slots exist (32), joints between the base and each slot's joint (32), which tells
    the order of a limb's joints, and each slot's axis in the base frame in the default pose (32 x 3), with the slot's
    sign. Absent slots are zero. All of it is its own mirror image but for the exchange of sides, see
    :func:`structure_mirror`.
    """
    tree = read_urdf(spec.urdf_path)
    poses = tree.forward(spec.default_joint_pos)
    axes = np.stack([poses[body.name].rot @ body.joint.axis for body in tree.bodies[1:] if body.joint is not None])
    return np.concatenate(
        [
            (limb_lengths(spec, tree, poses) - _LIMB_MEAN) / _LIMB_STD,
            spec.slot_mask.astype(float),
            spec.to_slots(_depths(tree) / _DEPTH_SCALE),
            spec.to_slots((spec.signs[:, None] * axes).T).T.ravel(),
        ]
    )


def resized_structure(rows: Tensor, length_scale: Tensor) -> Tensor:
    """Describe robots whose lengths are multiplied by a factor, shapes (N, 165) and (N,); only limbs change."""
    scale = length_scale.unsqueeze(1)
    centre = rows.new_tensor(_LIMB_MEAN / _LIMB_STD)
    limbs = (rows[:, : len(LIMBS)] + centre) * scale - centre
    return torch.cat([limbs, rows[:, len(LIMBS) :]], dim=1)


def structure_mirror() -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Permutation and signs of :func:`structure_vector` under the left/right mirror.

    An axis is an axial vector whose slot's sign mirrors too: a pitch axis keeps y and flips x and z, a roll or yaw axis
    flips y alone.
    """
    slots = [*MIRROR_PERMUTATION.tolist()]
    start = len(LIMBS)
    perm = [*range(start), *(start + s for s in slots), *(start + NUM_SLOTS + s for s in slots)]
    axes = start + 2 * NUM_SLOTS
    perm += [axes + 3 * s + k for s in slots for k in range(3)]
    signs = [1.0] * axes + [float(s * k) for s in MIRROR_SIGN for k in (-1.0, 1.0, -1.0)]
    return tuple(perm), tuple(signs)


def _depths(tree: Tree) -> Array:
    depths = [0]
    for body in tree.bodies[1:]:
        depths.append(depths[body.parent] + 1)
    return np.array(depths[1:], dtype=float)


def limb_lengths(spec: RobotSpec, tree: Tree, poses: dict[str, Pose]) -> Array:
    """Lengths of ``LIMBS`` [m], mean of both sides; 0 where a joint of the limb is missing."""
    return np.mean([_side_lengths(spec, tree, poses, side) for side in FEET], axis=0)


def _side_lengths(spec: RobotSpec, tree: Tree, poses: dict[str, Pose], side: str) -> list[float]:
    bodies = {int(slot): body.name for slot, body in zip(spec.slots, tree.bodies[1:], strict=True)}

    def origin(joint: str) -> Array | None:
        link = bodies.get(SLOT_INDEX[f"{side}_{joint}"])
        return None if link is None else poses[link].pos

    def distance(a: Array | None, b: Array | None) -> float:
        return 0.0 if a is None or b is None else float(np.linalg.norm(a - b))

    sole = poses[spec.link_roles[f"{side}_foot"]].apply(spec.sole_offsets[FEET.index(side)])
    hand = spec.link_roles[f"{side}_hand"]
    shapes = tree.locate(hand)[0].shapes
    elbow = origin("elbow_pitch")
    tips = [poses[hand].apply(shape.pose.pos) for shape in shapes] or [poses[hand].pos]
    return [
        distance(origin("hip_pitch"), origin("knee_pitch")),
        distance(origin("knee_pitch"), origin("ankle_pitch")),
        distance(origin("ankle_pitch"), sole),
        distance(origin("shoulder_pitch"), elbow),
        max(distance(elbow, tip) for tip in tips),
    ]
