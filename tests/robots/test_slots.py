"""A slot means the same motion on every robot, and left and right are mirror images."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from envs.robots.slots import MIRROR_PERMUTATION, MIRROR_SIGN, NUM_SLOTS, SLOT_INDEX, SLOT_NAMES
from envs.robots.spec import Array, RobotSpec
from envs.robots.tree import Tree
from envs.robots.urdf import read_urdf

from .vendor import ROBOTS, shipped

AXES = {"roll": np.array([1.0, 0.0, 0.0]), "pitch": np.array([0.0, 1.0, 0.0]), "yaw": np.array([0.0, 0.0, 1.0])}

TILT_DEG = {
    ("h1", "shoulder_pitch"): 25,
    ("g1", "hip_roll"): 10,
    ("g1", "hip_yaw"): 10,
    ("g1", "shoulder_pitch"): 16,
    ("n1", "hip_pitch"): 15,
    ("adam", "hip_pitch"): 35,
    ("adam", "shoulder_pitch"): 20,
}
"""Joints that the vendor mounted at an angle [deg]; every other axis is the canonical one."""

NUM_JOINTS = {"h1": 19, "g1": 29, "t1": 23, "n1": 23, "adam": 25}

robots = pytest.mark.parametrize("name", ROBOTS)


LEGS = "hip_pitch hip_roll hip_yaw knee_pitch ankle_pitch ankle_roll".split()
ARMS = "shoulder_pitch shoulder_roll shoulder_yaw elbow_pitch wrist_roll wrist_pitch wrist_yaw".split()


def test_slots_lie_as_in_the_paper_right_before_left() -> None:
    """Checkpoints and exports depend on this order."""
    assert [name.removeprefix("right_") for name in SLOT_NAMES[0:12:2]] == LEGS
    assert [name.removeprefix("left_") for name in SLOT_NAMES[1:12:2]] == LEGS
    assert SLOT_NAMES[12:18] == tuple(f"{part}_{axis}" for part in ("waist", "head") for axis in AXES)
    assert [name.removeprefix("right_") for name in SLOT_NAMES[18::2]] == ARMS
    assert [name.removeprefix("left_") for name in SLOT_NAMES[19::2]] == ARMS


@robots
def test_selection_undoes_permutation(name: str) -> None:
    spec = shipped(name)
    n = spec.num_joints
    assert n == NUM_JOINTS[name]
    padding = np.eye(NUM_SLOTS, n)
    np.testing.assert_array_equal(spec.selection_matrix() @ spec.permutation_matrix() @ padding, np.eye(n))
    np.testing.assert_array_equal(spec.permutation_matrix() @ spec.permutation_matrix().T, np.eye(NUM_SLOTS))


@robots
@given(data=st.data())
def test_canonical_angles_round_trip_and_absent_slots_stay_zero(name: str, data: st.DataObject) -> None:
    spec = shipped(name)
    native = data.draw(arrays(float, spec.num_joints, elements=st.floats(-4.0, 4.0)))
    canonical = spec.to_canonical(native)
    np.testing.assert_allclose(spec.to_native(canonical), native, atol=1e-12)
    assert not canonical[~spec.slot_mask].any()


@given(values=arrays(float, NUM_SLOTS, elements=st.floats(-10.0, 10.0)))
def test_mirroring_twice_is_the_identity(values: Array) -> None:
    once = MIRROR_SIGN * values[MIRROR_PERMUTATION]
    np.testing.assert_array_equal(MIRROR_SIGN * once[MIRROR_PERMUTATION], values)


@robots
def test_mirror_maps_a_robots_slots_onto_themselves(name: str) -> None:
    mask = shipped(name).slot_mask
    np.testing.assert_array_equal(mask[MIRROR_PERMUTATION], mask)


@robots
def test_default_pose_gains_and_limits_are_left_right_symmetric(name: str) -> None:
    spec = shipped(name)
    pose = spec.to_canonical(spec.default_joint_pos)
    np.testing.assert_allclose(MIRROR_SIGN * pose[MIRROR_PERMUTATION], pose, atol=1e-9)
    for field in ("stiffness", "damping", "armature", "effort_limit", "velocity_limit"):
        values = spec.to_slots(getattr(spec, field))
        np.testing.assert_array_equal(values[MIRROR_PERMUTATION], values, err_msg=field)
    ends = np.stack([spec.to_canonical(spec.joint_lower), spec.to_canonical(spec.joint_upper)])
    mirrored = ends[:, MIRROR_PERMUTATION] * MIRROR_SIGN
    np.testing.assert_allclose(np.sort(mirrored, axis=0), np.sort(ends, axis=0), atol=0.01, err_msg="limits")


@robots
def test_positive_slots_turn_the_distal_part_by_the_right_hand_rule(name: str) -> None:
    spec = shipped(name)
    tree = read_urdf(spec.urdf_path)
    for index, slot in enumerate(spec.slots):
        slot_name = SLOT_NAMES[slot]
        kind = slot_name.removeprefix("left_").removeprefix("right_")
        turn = _distal_turn(spec, tree, index, _posture(spec, slot_name))
        axis = AXES[kind.rpartition("_")[2]]
        tilt = math.degrees(math.acos(np.clip(turn @ axis, -1.0, 1.0)))
        expected = TILT_DEG.get((name, kind), 0)
        assert tilt == pytest.approx(expected, abs=0.6), f"{name} {slot_name}: axis {turn.round(3)}"


def _posture(spec: RobotSpec, slot_name: str) -> Array:
    """Canonical zero: straight, arms hanging; for a wrist, with the forearm forward, as its axes are named."""
    canonical = np.zeros(NUM_SLOTS)
    if "wrist" in slot_name:
        for side in ("left", "right"):
            canonical[SLOT_INDEX[f"{side}_elbow_pitch"]] = -math.pi / 2
    return spec.to_native(canonical)


def _distal_turn(spec: RobotSpec, tree: Tree, index: int, posture: Array) -> Array:
    """Unit axis, in the base frame, about which the distal part turns when the slot's canonical angle grows.

    The distal part is the one away from the pelvis: on T1, whose root is the trunk, the waist moves the legs.
    """
    step = 1e-4
    body = tree.bodies[index + 1]
    pushed = posture.copy()
    pushed[index] += spec.signs[index] * step
    rotation = tree.forward(pushed)[body.name].rot @ tree.forward(posture)[body.name].rot.T
    turn = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    carries_pelvis = spec.link_roles["pelvis"] in _subtree(tree, index + 1)
    return turn / np.linalg.norm(turn) * (-1.0 if carries_pelvis else 1.0)


def _subtree(tree: Tree, root: int) -> set[str]:
    inside = {root}
    for i, body in enumerate(tree.bodies):
        if body.parent in inside:
            inside.add(i)
    return {tree.bodies[i].name for i in inside}


@robots
def test_canonical_zero_is_standing_straight_with_hanging_arms(name: str) -> None:
    spec = shipped(name)
    tree = read_urdf(spec.urdf_path)
    poses = tree.forward(spec.to_native(np.zeros(NUM_SLOTS)))
    at = {SLOT_NAMES[slot]: poses[tree.bodies[i + 1].name].pos for i, slot in enumerate(spec.slots)}
    for side in ("left", "right"):
        for upper, lower in (
            ("hip_pitch", "knee_pitch"),
            ("knee_pitch", "ankle_pitch"),
            ("shoulder_pitch", "elbow_pitch"),
        ):
            down = at[f"{side}_{lower}"] - at[f"{side}_{upper}"]
            lean = math.degrees(math.atan2(abs(down[0]), -down[2]))
            assert lean < 11.0, f"{name} {side} {upper} to {lower}: {down.round(3)}"
        hand = tree.locate(spec.link_roles[f"{side}_hand"])[0]
        tip = poses[hand.name].apply(np.mean([s.pose.pos for s in hand.shapes], axis=0))
        forearm = tip - at[f"{side}_elbow_pitch"]
        assert forearm[2] < -0.9 * np.linalg.norm(forearm), f"{name} {side} forearm {forearm.round(3)}"
