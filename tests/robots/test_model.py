"""The compiled model: order, actuators, options, sensors, and that it stands."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from eagle_rl.config.schema import SimCfg
from envs.robots.load import load_robot
from envs.robots.model import KEYFRAME, add_floor, build_model, build_spec, set_options
from envs.robots.sensors import NUM_SENSORS, SENSOR_SLICES
from envs.robots.slots import SLOT_NAMES
from envs.robots.spec import COLLISION_LINKS, FEET, Array, RobotSpec
from envs.sim.height_field import HeightField

from .biped import NOMINAL_HEIGHT, biped_data, write_biped
from .vendor import ROBOTS, shipped

NUM_LEG_SLOTS = 12

robots = pytest.mark.parametrize("name", ROBOTS)


def _start(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(KEYFRAME).id)
    return data


def _read(data: mujoco.MjData, block: str) -> Array:
    values = data.sensordata[SENSOR_SLICES[block]]
    return values if block == "floor_contact" else values.reshape(-1, 3)


@robots
def test_joints_and_actuators_follow_the_spec(name: str) -> None:
    spec = shipped(name)
    model = build_model(spec, SimCfg())
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert tuple(model.joint(i).name for i in range(1, model.njnt)) == spec.joint_names
    assert tuple(model.actuator(i).name for i in range(model.nu)) == spec.joint_names
    np.testing.assert_array_equal(model.dof_damping[6:], spec.damping)
    np.testing.assert_array_equal(model.dof_armature[6:], spec.armature)
    np.testing.assert_array_equal(model.jnt_range[1:], np.stack([spec.joint_lower, spec.joint_upper], axis=1))
    assert model.jnt_limited[1:].all()


@robots
def test_actuator_force_is_kp_times_error_clipped_to_the_effort_limit(name: str) -> None:
    spec = shipped(name)
    model = build_model(spec, SimCfg())
    data = _start(model)
    error = np.linspace(-2.0, 2.0, spec.num_joints)
    data.ctrl[:] = data.qpos[7:] + error
    data.qvel[6:] = 1.0
    mujoco.mj_forward(model, data)
    expected = np.clip(spec.stiffness * error, -spec.effort_limit, spec.effort_limit)
    np.testing.assert_allclose(data.actuator_force, expected, atol=1e-9)
    np.testing.assert_allclose(data.qfrc_passive[6:], -spec.damping, atol=1e-12)


def test_options_come_from_the_configuration() -> None:
    cfg = SimCfg(physics_dt=0.004, solver_iterations=7, solver_ls_iterations=13)
    option = build_model(shipped("h1"), cfg).opt
    assert (option.timestep, option.iterations, option.ls_iterations, option.tolerance) == (0.004, 7, 13, 1e-8)
    assert option.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
    assert option.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    for flag in (mujoco.mjtDisableBit.mjDSBL_AUTORESET, mujoco.mjtDisableBit.mjDSBL_ISLAND):
        assert option.disableflags & int(flag)


@robots
def test_default_pose_puts_flat_soles_on_the_ground_with_nothing_else_touching(name: str) -> None:
    spec = shipped(name)
    model = build_model(spec, SimCfg())
    data = _start(model)
    mujoco.mj_forward(model, data)
    soles = _read(data, "sole_pos")
    np.testing.assert_allclose(soles[:, 2], 0.0, atol=1e-3)
    np.testing.assert_allclose(soles[0], soles[1] * [1.0, -1.0, 1.0], atol=1e-4)
    feet = {model.body(spec.link_roles[f"{side}_foot"]).id for side in FEET}
    floor = model.geom("floor").id
    for pair in data.contact.geom:
        names = [model.body(model.geom_bodyid[g]).name for g in pair]
        assert floor in pair, f"{names} touch"
        assert {int(model.geom_bodyid[g]) for g in pair} & feet, f"{names} touch"


@robots
def test_sole_sensors_match_finite_differences(name: str) -> None:
    model = build_model(shipped(name), SimCfg())
    data = _start(model)
    data.qpos[2] += 1.0
    data.qvel[:] = np.random.default_rng(0).normal(size=model.nv)
    mujoco.mj_forward(model, data)
    before, velocity = _read(data, "sole_pos").copy(), _read(data, "sole_vel").copy()
    dt = 1e-6
    mujoco.mj_integratePos(model, data.qpos, data.qvel, dt)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose((_read(data, "sole_pos") - before) / dt, velocity, atol=1e-4)


@robots
def test_foot_forces_carry_the_weight_of_a_robot_at_rest(name: str) -> None:
    spec = shipped(name)
    model = _stiffened(spec)
    data = _start(model)
    weight = spec.total_mass * 9.81
    for _ in range(500):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    force = _read(data, "foot_force")
    assert model.nsensordata == NUM_SENSORS
    assert force[:, 2].sum() == pytest.approx(weight, rel=0.02)
    assert force[:, 2].min() > 0.3 * weight
    assert np.abs(_read(data, "contact_force")).max() == 0.0
    assert _read(data, "floor_contact").max() == 0.0


@robots
def test_all_five_stand_five_seconds_on_stiff_ankles(name: str) -> None:
    model = _stiffened(shipped(name))
    data = _start(model)
    for _ in range(round(5.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    drift = np.linalg.norm(data.qpos[:3] - model.key(KEYFRAME).qpos[:3])
    assert drift < 0.02, f"{name} drifted {drift:.4f} m"


def _stiffened(spec: RobotSpec) -> mujoco.MjModel:
    """A model with five times the torque, ankles of 1500 N m/rad and nearly rigid hips and knees.

    Public ankle gains cannot hold a robot upright, and sagging knees would pass for drift.
    """
    model = build_model(spec, SimCfg(physics_dt=0.005))
    model.actuator_forcerange *= 5.0
    for joint, slot in enumerate(spec.slots):
        if slot >= NUM_LEG_SLOTS:
            continue
        stiffness = 1500.0 if "ankle" in SLOT_NAMES[slot] else 5000.0
        model.actuator_gainprm[joint, 0] = stiffness
        model.actuator_biasprm[joint, 1] = -stiffness
        model.dof_damping[6 + joint] *= np.sqrt(stiffness / spec.stiffness[joint])
    return model


def test_the_floor_alone_decides_friction(tmp_path: Path) -> None:
    model = build_model(load_robot(write_biped(tmp_path)), SimCfg())
    data = _start(model)
    data.qpos[2] -= 0.001
    model.geom_friction[model.geom("floor").id, 0] = 0.37
    mujoco.mj_forward(model, data)
    assert data.ncon == 8
    np.testing.assert_allclose(data.contact.friction[:, 0], 0.37)


def test_a_falling_robot_reports_its_torso_and_a_push_reports_the_link(tmp_path: Path) -> None:
    spec = load_robot(write_biped(tmp_path))
    model = build_model(spec, SimCfg())
    data = _start(model)
    data.qpos[2:7] = [0.1, np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]
    mujoco.mj_forward(model, data)
    torso = COLLISION_LINKS.index("torso")
    assert (_read(data, "floor_contact") > 0).tolist() == [True, False, True], "torso, pelvis, head (on the torso)"
    assert _read(data, "contact_force")[torso, 2] > 0.0


def test_contact_forces_are_those_on_the_body(tmp_path: Path) -> None:
    """Against MuJoCo's own sum of external forces, with thighs pressing on each other and feet on the ground."""
    spec = load_robot(write_biped(tmp_path))
    model = build_model(spec, SimCfg())
    model.body_pos[[model.body(f"{side}_thigh").id for side in FEET], 1] = [0.03, -0.03]
    data = _start(model)
    data.qpos[2] -= 0.001
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    links = [spec.link_roles[role] for role in COLLISION_LINKS]
    expected = np.array([data.body(link).cfrc_ext[3:] for link in links])
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(_read(data, "contact_force"), expected, atol=1e-6)
    feet = np.array([data.body(f"{side}_foot").cfrc_ext[3:] for side in FEET])
    np.testing.assert_allclose(_read(data, "foot_force")[:, 2], feet[:, 2], atol=1e-6)


@pytest.mark.parametrize("self_collision", [True, False])
def test_self_collision_is_switchable_and_leaves_the_floor_alone(tmp_path: Path, self_collision: bool) -> None:
    model = build_model(load_robot(write_biped(tmp_path)), SimCfg(self_collision=self_collision))
    model.body_pos[[model.body(f"{side}_thigh").id for side in FEET], 1] = [0.03, -0.03]
    data = _start(model)
    data.qpos[2] -= 0.001
    mujoco.mj_forward(model, data)
    floor = model.geom("floor").id
    own = [pair for pair in data.contact.geom.tolist() if floor not in pair]
    assert bool(own) is self_collision
    assert data.ncon - len(own) == 8, "four corners of each foot"


def test_excluded_pairs_never_touch(tmp_path: Path) -> None:
    model = build_model(load_robot(write_biped(tmp_path)), SimCfg())
    pairs = {(int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature}
    assert pairs == {tuple(sorted((model.body("torso").id, model.body("left_thigh").id)))}


def test_a_height_field_is_where_its_numbers_say(tmp_path: Path) -> None:
    rows, columns, cell = 21, 41, 0.1
    x = (np.arange(columns) - (columns - 1) / 2) * cell
    y = (np.arange(rows) - (rows - 1) / 2) * cell
    ground = HeightField(heights=0.2 * x[None, :] - 0.1 * y[:, None] + 0.05, cell_size=cell)
    spec = load_robot(write_biped(tmp_path))
    model = build_model(spec, SimCfg(), ground)
    data = _start(model)
    data.qpos[2] = 5.0
    mujoco.mj_forward(model, data)
    hit = np.zeros(1, dtype=np.int32)
    for px, py in ((0.0, 0.0), (1.3, 0.4), (-1.77, -0.83)):
        args = (model, data, np.array([px, py, 3.0]), np.array([0.0, 0.0, -1.0]), None, 1, model.body("pelvis").id, hit)
        distance = mujoco.mj_ray(*args)
        assert 3.0 - distance == pytest.approx(0.2 * px - 0.1 * py + 0.05, abs=1e-3)


def test_robots_can_share_a_scene(tmp_path: Path) -> None:
    scene = mujoco.MjSpec()
    add_floor(scene)
    set_options(scene, SimCfg())
    for index, name in enumerate(ROBOTS):
        frame = scene.worldbody.add_frame(pos=[0.0, float(index), 0.0])
        frame.attach_body(build_spec(shipped(name), SimCfg(), visuals=True).worldbody.first_body(), f"{name}/", "")
    model = scene.compile()
    assert model.nq == sum(7 + shipped(name).num_joints for name in ROBOTS)


def test_a_users_mesh_replaces_the_shapes_of_its_link(tmp_path: Path) -> None:
    (tmp_path / "torso.obj").write_text("v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    spec = load_robot(write_biped(tmp_path, data={**biped_data(), "mesh_dir": "."}))
    shown = build_spec(spec, SimCfg(), visuals=True).compile()
    types = shown.geom_type[shown.geom_bodyid == shown.body("torso").id]
    assert set(types) == {int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_MESH)}
    assert build_model(spec, SimCfg()).nmesh == 0, "training never loads meshes"
    assert spec.nominal_height == NOMINAL_HEIGHT
