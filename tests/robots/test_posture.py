"""The pose robots rest in at a commanded height and pitch, checked by MuJoCo's kinematics."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
import pytest

from eagle_rl.config.schema import SimCfg
from envs.robots.load import load_robot
from envs.robots.model import build_model
from envs.robots.posture import HEIGHTS, PITCH_JOINTS, PITCHES, POSTURE_SLOTS, joint_offsets, posture_table
from envs.robots.slots import NUM_SLOTS
from envs.robots.spec import FEET

ROBOTS = ("h1", "g1", "t1", "n1", "adam")
WITHIN_REACH = [(h, p) for h in (-0.1, 0.0) for p in (0.0, 0.2, 0.4)]


def measured(robot, bend, pitch):
    """Tilt of the soles [rad], base height above them, centre of mass ahead of them [m], by MuJoCo."""
    spec, model = _model(robot)
    data = mujoco.MjData(model)
    slots = np.zeros(NUM_SLOTS)
    slots[np.array(POSTURE_SLOTS)] = bend
    data.qpos[3:7] = np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0
    data.qpos[7:] = spec.default_joint_pos + spec.signs * slots[spec.slots]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    feet = [data.body(spec.link_roles[f"{side}_foot"]) for side in FEET]
    rotations = [foot.xmat.reshape(3, 3) for foot in feet]
    soles = [f.xpos + r @ s for f, r, s in zip(feet, rotations, spec.sole_offsets, strict=True)]
    tilt = np.mean([np.arctan2(-r[2, 0], r[0, 0]) for r in rotations])
    centre = data.subtree_com[1]
    return tilt, -np.mean([s[2] for s in soles]), centre[0] - np.mean([s[0] for s in soles])


@functools.cache
def _model(robot):
    spec = load_robot(robot)
    return spec, build_model(spec, SimCfg())


def node(table, height, pitch):
    return table[int(np.argmin(np.abs(np.array(HEIGHTS) - height))), int(np.argmin(np.abs(np.array(PITCHES) - pitch)))]


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_default_pose_stays_as_it_is(robot):
    np.testing.assert_allclose(node(posture_table(load_robot(robot)), 0.0, 0.0), 0.0, atol=1e-9)


@pytest.mark.parametrize("robot", ROBOTS)
def test_within_reach_the_base_is_where_it_is_commanded_over_flat_soles_and_in_balance(robot):
    table = posture_table(load_robot(robot))
    rest = measured(robot, np.zeros(3), 0.0)
    for height, pitch in WITHIN_REACH:
        tilt, base, ahead = measured(robot, node(table, height, pitch), pitch)
        where = f"{robot} at {height} m, {pitch} rad"
        assert tilt == pytest.approx(rest[0], abs=1e-4), where
        assert base == pytest.approx(rest[1] + height, abs=1e-4), where
        assert ahead == pytest.approx(rest[2], abs=1e-4), where


@pytest.mark.parametrize("robot", ROBOTS)
def test_where_joints_end_height_is_given_up_before_flat_soles_and_balance(robot):
    spec = load_robot(robot)
    table = posture_table(spec)
    for height in (-0.3, -0.2):
        for pitch in (-0.3, 0.0, 0.5):
            bend = node(table, height, pitch)
            tilt, base, ahead = measured(robot, bend, pitch)
            missing = base - spec.nominal_height - height
            where = f"{robot} at {height} m, {pitch:.1f} rad: tilt {tilt:.3f}, {missing:.3f} m too high"
            assert abs(tilt) < 0.03, where
            assert -0.005 < missing < 0.16, where
            assert abs(ahead - measured(robot, np.zeros(3), 0.0)[2]) < 0.025, f"{where}, {ahead:.3f} m ahead"


@pytest.mark.parametrize("robot", ROBOTS)
def test_nowhere_does_a_robot_rest_4_cm_from_its_balance_and_height_is_given_up_only_where_a_joint_ends(robot):
    """The whole table: commands of -0.3 m are told 1.25 times as deep."""
    spec = load_robot(robot)
    table, rest = posture_table(spec), measured(robot, np.zeros(3), 0.0)
    legs = [spec.slots.tolist().index(slot) for slot in POSTURE_SLOTS[0]]
    ends = spec.signs[legs] * (np.stack([spec.joint_lower, spec.joint_upper])[:, legs] - spec.default_joint_pos[legs])
    for height in HEIGHTS:
        for pitch in PITCHES:
            bend = node(table, height, pitch)
            _, base, ahead = measured(robot, bend, pitch)
            where = f"{robot} at {height:.2f} m, {pitch:.1f} rad"
            assert abs(ahead - rest[2]) < 0.04, f"{where}: {ahead - rest[2]:.3f} m ahead"
            at_an_end = np.abs(ends - bend).min() < 1e-6
            assert base - rest[1] - height < 1e-3 or at_an_end, f"{where}: {base - rest[1]:.3f} m, no joint ends"


@pytest.mark.parametrize("robot", ROBOTS)
def test_no_pose_is_beyond_a_joint_limit(robot):
    spec = load_robot(robot)
    angles = spec.default_joint_pos + spec.signs * joint_offsets(spec)
    assert (angles >= spec.joint_lower - 1e-9).all(), f"{robot}: {spec.joint_names}"
    assert (angles <= spec.joint_upper + 1e-9).all(), f"{robot}: {spec.joint_names}"


def test_both_legs_bend_alike_and_nothing_else_moves():
    spec = load_robot("t1")
    offsets, table = joint_offsets(spec), posture_table(spec)
    slots = spec.slots.tolist()
    for side in POSTURE_SLOTS:
        for joint, slot in enumerate(side):
            moved = offsets[..., slots.index(slot)]
            np.testing.assert_array_equal(moved, table[..., joint], err_msg=PITCH_JOINTS[joint])
    others = [i for i, slot in enumerate(slots) if slot not in np.ravel(POSTURE_SLOTS)]
    assert not offsets[..., others].any()
