"""Faults of a robot that no single number shows: which way and on which side its joints turn, what it stands on."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from .slots import AXES, LEG_AND_WAIST_SLOTS, LEG_PITCH_SLOTS, MIRROR_PERMUTATION, MIRROR_SIGN, SLOT_NAMES, slot_frame
from .spec import FEET, Array, RobotSpec
from .tree import Body, Pose, Tree

HEIGHT_TOLERANCE = 0.01
"""Most that ``nominal_height_m`` may differ from forward kinematics [m]."""
MAX_TILT = math.radians(60.0)
"""Most that a joint may be tilted from its slot's axis, and a limb at canonical zero from straight down [rad]."""

LIMBS = {
    "thigh": ("hip_pitch", "knee_pitch"),
    "shank": ("knee_pitch", "ankle_pitch"),
    "upper arm": ("shoulder_pitch", "elbow_pitch"),
    "forearm": ("elbow_pitch", "hand"),
}
"""Where each limb begins and ends: at a slot's joint, or at the hand's centre of mass."""


def consistency_faults(spec: RobotSpec, tree: Tree) -> list[str]:
    """Faults of default pose, axes, zeros, sides, left/right symmetry, feet and nominal height, one sentence each."""
    faults = [
        f"joints.{name}.default_angle_rad is {angle:g}, outside its limits [{lower:g}, {upper:g}]"
        for name, angle, lower, upper in zip(
            spec.joint_names, spec.default_joint_pos, spec.joint_lower, spec.joint_upper, strict=True
        )
        if not lower <= angle <= upper
    ]
    absent = [SLOT_NAMES[slot] for slot in LEG_PITCH_SLOTS if not spec.slot_mask[slot]]
    if absent:
        faults.append(f"no joint in slots {', '.join(absent)}; legs must bend at hip, knee and ankle")
    faults += direction_faults(spec, tree, LEG_AND_WAIST_SLOTS)
    faults += _swapped_sides(spec, tree)
    faults += _asymmetries(spec)
    faults += _feet_without_shapes(spec, tree)
    height = default_height(spec, tree)
    if abs(height - spec.nominal_height) > HEIGHT_TOLERANCE:
        faults.append(
            f"nominal_height_m is {spec.nominal_height:g}, but in the default pose the base is {height:.4f} m above "
            "the lower sole; correct it, or default_angle_rad, or sole_centre_m"
        )
    return faults


def direction_faults(spec: RobotSpec, tree: Tree, slots: Collection[int]) -> list[str]:
    """Limbs from ``slots`` that do not hang at canonical zero, and joints that do not turn as their slot says.

    Legs and waist must, or a policy means another motion; arms and head may be built otherwise.
    """
    standing = tree.forward(spec.zero_offsets)
    return [*_wrong_zeros(spec, tree, standing, slots), *_wrong_axes(spec, _turns(spec, tree, standing), slots)]


def default_height(spec: RobotSpec, tree: Tree) -> float:
    """Height of the base above the lower sole centre in the default pose, base upright [m]."""
    poses = tree.forward(spec.default_joint_pos)
    feet = [poses[spec.link_roles[f"{side}_foot"]] for side in FEET]
    return -min(float(foot.apply(sole)[2]) for foot, sole in zip(feet, spec.sole_offsets, strict=True))


def shapeless(body: Body, role: str, consequence: str) -> str:
    """Say that a body has no collision shape, and whether it is because a mesh was ignored."""
    mesh = ": its mesh is ignored" if body.collision_mesh else ""
    return (
        f"{body.name}, the {role}, has no collision shape{mesh}, so {consequence}; give it a <collision> with a box, "
        "sphere or cylinder"
    )


def _turns(spec: RobotSpec, tree: Tree, standing: dict[str, Pose]) -> Array:
    """Axes, in the base frame at canonical zero, about which positive slots turn what is farther from the pelvis.

    Shape (n, 3), unit length. Where the pelvis hangs on the torso, the waist turns the near part against it.
    """
    names = [body.name for body in tree.bodies]
    axes = [standing[name].rot @ joint.axis for name, joint in zip(names[1:], tree.joints, strict=True)]
    turns = spec.signs[:, None] * np.reshape(axes, (-1, 3))
    index = names.index(spec.link_roles["pelvis"])
    while index > 0:
        turns[index - 1] *= -1.0
        index = tree.bodies[index].parent
    return turns


def _wrong_axes(spec: RobotSpec, turns: Array, slots: Collection[int]) -> list[str]:
    faults = []
    for joint, slot, sign, turn in zip(spec.joint_names, spec.slots, spec.signs, turns, strict=True):
        name = SLOT_NAMES[slot]
        along = slot_frame(name) @ turn
        own, nearest = AXES.index(name.rpartition("_")[2]), int(np.argmax(np.abs(along)))
        if slot not in slots or along[own] >= math.cos(MAX_TILT):
            continue
        if along[own] <= -math.cos(MAX_TILT):
            faults.append(f"joints.{joint}: turns the other way than slot {name}, expected sign {-sign:g}")
        else:
            faults.append(
                f"joints.{joint}: turns about {'xyz'[nearest]} ({AXES[nearest]}), slot {name} is about {'xyz'[own]}; "
                "exchange slots, or correct zero_offset_rad of a joint between it and the base"
            )
    return faults


def _wrong_zeros(spec: RobotSpec, tree: Tree, standing: dict[str, Pose], slots: Collection[int]) -> list[str]:
    at = {SLOT_NAMES[slot]: standing[body.name].pos for slot, body in zip(spec.slots, tree.bodies[1:], strict=True)}
    for side in FEET:
        hand = tree.locate(spec.link_roles[f"{side}_hand"])[0]
        at[f"{side}_hand"] = standing[hand.name].apply(hand.inertial.com)
    wanted = {SLOT_NAMES[slot] for slot in slots}
    faults = []
    for limb, ends in LIMBS.items():
        for top, end in ((f"{side}_{ends[0]}", f"{side}_{ends[1]}") for side in FEET):
            if top not in wanted or top not in at or end not in at:
                continue
            along = at[end] - at[top]
            length = float(np.linalg.norm(along))
            if -along[2] < math.cos(MAX_TILT) * length:
                angle = math.degrees(math.acos(max(-1.0, -along[2] / length)))
                faults.append(
                    f"joints: with every joint at its zero_offset_rad the {limb} from {top} to {end} is {angle:.0f} "
                    "degrees off straight down; correct zero_offset_rad, or the slots"
                )
    return faults


def _swapped_sides(spec: RobotSpec, tree: Tree) -> list[str]:
    """Left links and joints that are not to the left of the right ones: all that is left or right would be mixed up."""
    poses, links = tree.forward(spec.default_joint_pos), spec.link_roles
    points = {role: np.zeros(3) for role in links} | {
        f"{side}_foot": sole for side, sole in zip(FEET, spec.sole_offsets, strict=True)
    }
    roles = {role: float(poses[link].apply(points[role])[1]) for role, link in links.items()}
    bodies = zip(spec.slots, tree.bodies[1:], strict=True)
    slots = {SLOT_NAMES[slot]: float(poses[body.name].pos[1]) for slot, body in bodies}
    return [
        f"{where}: left_{part} is at y = {across[f'left_{part}']:.3f} m in the default pose and right_{part} at "
        f"{across[f'right_{part}']:.3f} m, expected the left one at the larger y; are they swapped?"
        for where, across in (("roles", roles), ("slots", slots))
        for part in (name.removeprefix("left_") for name in across if name.startswith("left_"))
        if f"right_{part}" in across and across[f"left_{part}"] <= across[f"right_{part}"]
    ]


def _asymmetries(spec: RobotSpec) -> list[str]:
    mask = spec.slot_mask
    unpaired = [SLOT_NAMES[slot] for slot in np.flatnonzero(mask & ~mask[MIRROR_PERMUTATION])]
    if unpaired:
        return [f"slots without their left/right partner: {', '.join(unpaired)}"]
    canonical = spec.to_canonical(spec.default_joint_pos)
    mirrored = MIRROR_SIGN * canonical[MIRROR_PERMUTATION]
    return [
        f"default pose is not left/right symmetric at {SLOT_NAMES[slot]}: canonical {canonical[slot]:g} rad, "
        f"mirror image {mirrored[slot]:g}"
        for slot in np.flatnonzero(np.abs(canonical - mirrored) > 1e-6)
    ]


def _feet_without_shapes(spec: RobotSpec, tree: Tree) -> list[str]:
    feet = {f"{side}_foot": tree.locate(spec.link_roles[f"{side}_foot"])[0] for side in FEET}
    return [shapeless(body, role, "it would sink into the ground") for role, body in feet.items() if not body.can_touch]
