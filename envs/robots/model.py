"""From a ``RobotSpec`` to MuJoCo: floating base, PD actuators with effort clipping, floor, contact sensing."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from eagle_rl.config.schema import SimCfg
from eagle_rl.errors import RobotError
from envs.sim.height_field import HeightField

from .sensors import FLOOR, IMU_SITE, NUM_SENSORS, SENSOR_SLICES, SOLE_SITES, add_sensors
from .spec import Array, RobotSpec
from .tree import Body, Shape
from .urdf import read_urdf

__all__ = ["KEYFRAME", "NUM_SENSORS", "SENSOR_SLICES", "add_floor", "build_model", "build_spec", "set_options"]

KEYFRAME = "default"
"""Name of the keyframe that holds the default pose."""

VISUAL_GROUP = 2
COLLISION_GROUP = 3
"""Geom groups; renderers show groups 0 to 2 unless told otherwise."""

_GEOM_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
_MESH_SUFFIXES = (".obj", ".stl")
_FLOOR_BIT, _ROBOT_BIT = 1, 2
_FLOOR_DEPTH = 1.0
"""Thickness of the ground below the lowest point of a height field [m]."""


def build_model(spec: RobotSpec, sim: SimCfg, heightfield: HeightField | None = None) -> mujoco.MjModel:
    """Compile the training model of a robot: collision shapes only, floor, options of ``sim``.

    ``qpos`` is base position (3), base quaternion wxyz (4), joints in ``spec.joint_names`` order; ``ctrl`` is the PD
    target [rad] in the same order. kp acts in the actuator, whose force is clipped to the effort limit, and kd as
    passive joint damping, so that it stays implicit when the actuator saturates; the motor's torque is
    ``actuator_force - kd * qvel``.

    Raises:
        RobotError: if MuJoCo refuses the robot.
    """
    try:
        world = build_spec(spec, sim)
        add_floor(world, heightfield)
        add_sensors(world, spec)
        return _with_movable_centres(world.compile())
    except RobotError:
        raise
    except ValueError as error:
        raise RobotError(f"{spec.yaml_path}: MuJoCo refuses the robot: {error}") from error


def _with_movable_centres(model: mujoco.MjModel) -> mujoco.MjModel:
    """Drop MuJoCo's shortcuts for frames that coincide with a centre of mass: randomization moves the centres."""
    model.body_sameframe[1:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    for frames in (model.geom_sameframe, model.site_sameframe):
        frames[frames == mujoco.mjtSameFrame.mjSAMEFRAME_INERTIA] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        frames[frames == mujoco.mjtSameFrame.mjSAMEFRAME_INERTIAROT] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    return model


def build_spec(spec: RobotSpec, sim: SimCfg, *, visuals: bool = False) -> mujoco.MjSpec:
    """Build the robot alone, without floor or sensors, so that several can be attached to one scene.

    With ``visuals`` the shapes that only show are added; where ``spec.mesh_dir`` holds ``<link>.obj`` or
    ``<link>.stl``, that mesh is shown on the link instead.
    """
    world = mujoco.MjSpec()
    world.modelname = spec.name
    set_options(world, sim)
    tree = read_urdf(spec.urdf_path)
    bodies: list[mujoco.MjsBody] = []
    for body in tree.bodies:
        parent = world.worldbody if body.parent < 0 else bodies[body.parent]
        bodies.append(_add_body(parent, body, spec))
        meshes = _meshes(spec, body) if visuals else {}
        _add_meshes(world, bodies[-1], body, meshes)
        for shape in body.shapes:
            if not shape.visual or (visuals and not meshes):
                _add_geom(bodies[-1], shape, sim.self_collision)
    for index in range(spec.num_joints):
        _add_actuator(world, spec, index)
    for first, second in spec.collision_excludes:
        world.add_exclude(bodyname1=first, bodyname2=second)
    _add_sites(world, spec)
    qpos = np.concatenate([[0.0, 0.0, spec.nominal_height, 1.0, 0.0, 0.0, 0.0], spec.default_joint_pos])
    world.add_key(name=KEYFRAME, qpos=qpos, ctrl=spec.default_joint_pos)
    return world


def add_floor(world: mujoco.MjSpec, heightfield: HeightField | None = None) -> None:
    """Add the ground: a plane, or a height field. Its priority makes its friction the only one that counts."""
    floor = world.worldbody.add_geom(
        name=FLOOR,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 1.0],
        priority=1,
        condim=3,
        friction=[1.0, 0.005, 0.0001],
        contype=_FLOOR_BIT,
        conaffinity=0,
        rgba=[0.45, 0.47, 0.5, 1.0],
    )
    if heightfield is None:
        return
    heights = heightfield.heights
    low, span = float(heights.min()), max(float(np.ptp(heights)), 1e-6)
    rows, columns = heights.shape
    half_x, half_y = ((n - 1) / 2 * heightfield.cell_size for n in (columns, rows))
    world.add_hfield(
        name=FLOOR,
        nrow=rows,
        ncol=columns,
        size=[half_x, half_y, span, _FLOOR_DEPTH],
        userdata=((heights - low) / span).ravel(),
    )
    floor.type, floor.hfieldname, floor.pos = mujoco.mjtGeom.mjGEOM_HFIELD, FLOOR, [0.0, 0.0, low]


def set_options(world: mujoco.MjSpec, sim: SimCfg) -> None:
    """Set solver and integrator; a scene that robots are attached to needs the same options as they have."""
    world.compiler.degree = False
    world.compiler.balanceinertia = False
    option = world.option
    option.timestep = sim.physics_dt
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.iterations = sim.solver_iterations
    option.ls_iterations = sim.solver_ls_iterations
    option.tolerance = 1e-8
    disable = mujoco.mjtDisableBit
    option.disableflags |= int(disable.mjDSBL_ISLAND) | int(disable.mjDSBL_AUTORESET)
    option.disableflags |= int(disable.mjDSBL_MIDPHASE)  # its boxes do not follow a centre of mass that is moved


def _add_body(parent: mujoco.MjsBody, body: Body, spec: RobotSpec) -> mujoco.MjsBody:
    inertial = body.inertial
    out = parent.add_body(
        name=body.name,
        pos=body.pose.pos,
        quat=_quaternion(body.pose.rot),
        mass=inertial.mass,
        ipos=inertial.com,
        fullinertia=[*np.diag(inertial.inertia), *inertial.inertia[[0, 0, 1], [1, 2, 2]]],
        explicitinertial=True,
    )
    if body.joint is None:
        out.add_freejoint(name="base")
    else:
        _add_joint(out, body, spec)
    return out


def _meshes(spec: RobotSpec, body: Body) -> dict[str, Path]:
    """The user's mesh file of each link of a body, where there is one."""
    if spec.mesh_dir is None:
        return {}
    files = {path.stem: path for path in spec.mesh_dir.iterdir() if path.suffix.lower() in _MESH_SUFFIXES}
    return {link: files[link] for link in body.members if link in files}


def _add_meshes(world: mujoco.MjSpec, out: mujoco.MjsBody, body: Body, meshes: dict[str, Path]) -> None:
    for link, path in meshes.items():
        world.add_mesh(name=link, file=str(path))
        out.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=link,
            pos=body.members[link].pos,
            quat=_quaternion(body.members[link].rot),
            rgba=body.shapes[0].rgba if body.shapes else [0.6, 0.6, 0.6, 1.0],
            group=VISUAL_GROUP,
            contype=0,
            conaffinity=0,
        )


def _add_joint(out: mujoco.MjsBody, body: Body, spec: RobotSpec) -> None:
    assert body.joint is not None
    index = spec.joint_names.index(body.joint.name)
    out.add_joint(
        name=body.joint.name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=body.joint.axis,
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=[spec.joint_lower[index], spec.joint_upper[index]],
        damping=spec.damping[index],
        armature=spec.armature[index],
    )


def _add_geom(out: mujoco.MjsBody, shape: Shape, self_collision: bool) -> None:
    size = np.zeros(3)
    size[: len(shape.size)] = shape.size
    geom = out.add_geom(
        type=_GEOM_TYPES[shape.kind],
        size=size,
        pos=shape.pose.pos,
        quat=_quaternion(shape.pose.rot),
        rgba=shape.rgba,
        group=VISUAL_GROUP if shape.visual else COLLISION_GROUP,
        contype=0,
        conaffinity=0,
    )
    if not shape.visual:
        geom.contype = _ROBOT_BIT if self_collision else 0
        geom.conaffinity = (_ROBOT_BIT | _FLOOR_BIT) if self_collision else _FLOOR_BIT


def _add_actuator(world: mujoco.MjSpec, spec: RobotSpec, index: int) -> None:
    gain, effort = spec.stiffness[index], spec.effort_limit[index]
    actuator = world.add_actuator(
        name=spec.joint_names[index],
        target=spec.joint_names[index],
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        ctrllimited=mujoco.mjtLimited.mjLIMITED_FALSE,
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        forcerange=[-effort, effort],
    )
    actuator.gainprm[0] = gain
    actuator.biasprm[1] = -gain


def _add_sites(world: mujoco.MjSpec, spec: RobotSpec) -> None:
    feet = [spec.link_roles["left_foot"], spec.link_roles["right_foot"]]
    links = [*feet, spec.imu_link]
    points = [*spec.sole_offsets, spec.imu_offset]
    for name, link, point in zip((*SOLE_SITES, IMU_SITE), links, points, strict=True):
        world.body(link).add_site(name=name, pos=point, size=[0.01, 0.01, 0.01], group=4)


def _quaternion(rot: Array) -> Array:
    """Quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(rot).ravel())
    return out
