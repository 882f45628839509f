"""Our URDFs are the vendors' robots: same masses, inertias, limits and kinematics in our tree, MuJoCo and Pinocchio."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio
import pytest

from eagle_rl.config.schema import SimCfg
from envs.robots.check import mass_matrix
from envs.robots.embodiment import pinocchio_model
from envs.robots.load import robot_names
from envs.robots.model import build_model
from envs.robots.spec import Array, RobotSpec
from envs.robots.urdf import read_urdf

from .vendor import ROBOTS, shipped, vendor_joint_pos, vendor_numbers

POINTS = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0]])


def test_the_five_robots_are_shipped() -> None:
    assert set(robot_names()) == set(ROBOTS)


@pytest.mark.parametrize("name", ROBOTS)
def test_total_mass_is_the_vendors(name: str) -> None:
    spec = shipped(name)
    expected = vendor_numbers(name)["total_mass"]
    assert spec.total_mass == pytest.approx(expected, abs=1e-6)
    assert build_model(spec, SimCfg()).body_mass.sum() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", ROBOTS)
def test_joint_order_and_limits_are_the_vendors(name: str) -> None:
    spec, joints = shipped(name), vendor_numbers(name)["joints"]
    assert spec.joint_names == tuple(joints)
    ours = np.stack([spec.joint_lower, spec.joint_upper, spec.effort_limit, spec.velocity_limit], axis=1)
    np.testing.assert_allclose(ours, list(joints.values()), atol=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_every_merged_body_has_the_vendors_inertia(name: str) -> None:
    spec = shipped(name)
    expected = vendor_numbers(name)["bodies"]
    tree, model = read_urdf(spec.urdf_path), build_model(spec, SimCfg())
    assert [body.name for body in tree.bodies] == [model.body(i).name for i in range(1, model.nbody)]
    assert {body.name for body in tree.bodies} == set(expected)
    for body in tree.bodies:
        inertial = body.inertial
        ours = _numbers(inertial.mass, inertial.com, inertial.inertia)
        np.testing.assert_allclose(ours, expected[body.name], atol=1e-6, err_msg=f"our tree, {body.name}")
        compiled = model.body(body.name)
        rot = _matrix(compiled.iquat)
        theirs = _numbers(compiled.mass[0], compiled.ipos, rot @ np.diag(compiled.inertia) @ rot.T)
        np.testing.assert_allclose(theirs, expected[body.name], atol=1e-6, err_msg=f"MuJoCo, {body.name}")


@pytest.mark.parametrize("name", ROBOTS)
def test_torso_feet_and_hands_are_where_the_vendor_has_them_in_100_poses(name: str) -> None:
    spec, numbers = shipped(name), vendor_numbers(name)
    tree, model = read_urdf(spec.urdf_path), build_model(spec, SimCfg())
    data = mujoco.MjData(model)
    assert len(numbers["poses"]) == 100
    for index, expected in enumerate(np.array(numbers["poses"])):
        angles = vendor_joint_pos(numbers, index)
        poses = tree.forward(angles)
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *angles]
        mujoco.mj_kinematics(model, data)
        for link, points in zip(numbers["links"], expected.reshape(-1, 3, 3), strict=True):
            body, offset = tree.locate(link)
            local = np.array([offset.apply(point) for point in POINTS])
            ours = np.array([poses[body.name].apply(point) for point in local])
            np.testing.assert_allclose(ours, points, atol=1e-6, err_msg=f"our tree, {link}, pose {index}")
            at = data.body(body.name)
            theirs = at.xpos + local @ at.xmat.reshape(3, 3).T
            np.testing.assert_allclose(theirs, points, atol=1e-6, err_msg=f"MuJoCo, {link}, pose {index}")


@pytest.mark.parametrize("name", ROBOTS)
def test_mass_matrices_of_pinocchio_and_mujoco_agree(name: str) -> None:
    spec = shipped(name)
    model = build_model(spec, SimCfg())
    model.dof_armature[:] = 0.0
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(5):
        quat = rng.normal(size=4)
        data.qpos[:] = [*rng.normal(size=3), *(quat / np.linalg.norm(quat)), *rng.uniform(-0.5, 0.5, spec.num_joints)]
        mujoco.mj_forward(model, data)
        ours = mass_matrix(model, data)
        theirs = _pinocchio_mass_matrix(spec, data.qpos)
        np.testing.assert_allclose(ours, theirs, atol=1e-6 * np.abs(theirs).max())


def _pinocchio_mass_matrix(spec: RobotSpec, qpos: Array) -> Array:
    """Pinocchio's mass matrix in MuJoCo's coordinates: native joint order, base velocity along world axes."""
    model = pinocchio_model(spec)
    joints = [model.joints[model.getJointId(name)] for name in spec.joint_names]
    q = pinocchio.neutral(model)
    q[:7] = [*qpos[:3], *qpos[4:7], qpos[3]]
    for joint, angle in zip(joints, qpos[7:], strict=True):
        q[joint.idx_q] = angle
    data = model.createData()
    pinocchio.crba(model, data, q)
    full = np.triu(data.M) + np.triu(data.M, 1).T
    order = [*range(6), *(joint.idx_v for joint in joints)]
    to_local = np.eye(len(order))
    to_local[:3, :3] = _matrix(qpos[3:7]).T
    return np.asarray(to_local.T @ full[np.ix_(order, order)] @ to_local)


def _numbers(mass: float, com: Array, inertia: Array) -> list[float]:
    return [mass, *com, *np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]


def _matrix(quat: Array) -> Array:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quat)
    return out.reshape(3, 3)
