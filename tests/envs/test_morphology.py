"""Bodies of other sizes and masses are the bodies one would have written into the URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from eagle_rl.config.schema import ObservationsCfg, RandomizationCfg, SimCfg, TaskCfg
from envs.humanoid_env import HumanoidEnv
from envs.robots.embodiment import nominal_embodiment, reference_statistics
from envs.robots.load import load_robot
from envs.robots.model import build_model
from envs.robots.spec import Array, RobotSpec
from envs.robots.structure import LIMBS, structure_vector
from envs.sim.batch import RobotBatch
from tests.envs.test_randomization import field
from tests.envs.worlds import BARE, actions, assert_same, make_env, rollout, with_randomization
from tests.robots.biped import BOXES, biped_data, biped_urdf, box_moments, write_biped

LENGTH, MASS = 1.3, 0.7
SIM = SimCfg()


def batch_of(spec: RobotSpec, length: list[float], mass: list[float]) -> RobotBatch:
    """Simulations of one robot in several sizes."""
    batch = RobotBatch(spec, build_model(spec, SIM), len(length), SIM.decimation)
    bodies = (len(length), batch.model.nbody)
    scale = np.repeat(np.array(mass)[:, None], bodies[1], axis=1)
    batch.change_bodies(np.array(length), scale, np.zeros(bodies), np.zeros((*bodies, 3)))
    return batch


def scaled_biped(folder: Path) -> RobotSpec:
    """The biped written with other numbers: lengths x LENGTH, masses x MASS, inertia x MASS LENGTH^2."""
    root = ET.fromstring(biped_urdf())
    factors = {"xyz": LENGTH, "size": LENGTH, "value": MASS}
    factors |= dict.fromkeys(("ixx", "iyy", "izz"), MASS * LENGTH**2)
    for element in root.iter():
        for name in set(element.attrib) & set(factors) - ({"xyz"} if element.tag == "axis" else set()):
            numbers = [repr(float(x) * factors[name]) for x in element.attrib[name].split()]
            element.attrib[name] = " ".join(numbers)
    data = biped_data()
    data["nominal_height_m"] *= LENGTH
    for sole in data["sole_centre_m"].values():
        sole[:] = [LENGTH * x for x in sole]
    return load_robot(write_biped(folder, ET.tostring(root, encoding="unicode"), data))


def test_boxes_have_the_mass_size_and_inertia_of_scaled_boxes(tmp_path: Path) -> None:
    batch = batch_of(load_robot(write_biped(tmp_path)), [1.0, LENGTH], [1.0, MASS])
    for name, box in {"torso": "torso", "left_shank": "shank", "right_foot": "foot"}.items():
        mass, size, centre = BOXES[box]
        body = batch.model.body(name)
        model = batch._batch.get_model(1)
        large = tuple(LENGTH * x for x in size)
        assert model.body_mass[body.id] == pytest.approx(MASS * mass)
        assert np.allclose(sorted(model.body_inertia[body.id]), sorted(box_moments(MASS * mass, large)))
        assert np.allclose(model.body_ipos[body.id], LENGTH * np.array(centre))
        assert np.allclose(model.geom_size[body.geomadr[0]], np.array(large) / 2)
        assert np.allclose(batch._batch.get_model(0).geom_size[body.geomadr[0]], np.array(size) / 2), "its neighbour"


def test_a_leg_swings_like_a_pendulum_of_its_size(tmp_path: Path) -> None:
    """The foot about its ankle: I = m s^2 (I_com + M d^2) + armature against a weight m s M g d."""
    batch = batch_of(load_robot(write_biped(tmp_path)), [LENGTH], [MASS])
    model = batch._batch.get_model(0)
    data = mujoco.MjData(model)
    dof, joint = model.joint("left_ankle_pitch").dofadr[0], model.joint("left_ankle_pitch").qposadr[0]
    mass, size, (x, _, z) = BOXES["foot"]
    data.qpos[3], data.qpos[joint] = 1.0, 0.3
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    about_ankle = box_moments(mass, size)[1] + mass * (x * x + z * z)
    assert inertia[dof, dof] == pytest.approx(MASS * LENGTH**2 * about_ankle + 0.02)
    lever = x * np.cos(0.3) + z * np.sin(0.3)
    assert data.qfrc_bias[dof] == pytest.approx(-MASS * LENGTH * mass * 9.81 * lever)


def test_a_scaled_robot_moves_like_one_built_that_way(tmp_path: Path) -> None:
    """Falling onto its feet and flailing: geometry, contacts, sensors and derived constants all agree."""
    (tmp_path / "plain").mkdir()
    (tmp_path / "scaled").mkdir()
    spec, large = load_robot(write_biped(tmp_path / "plain")), scaled_biped(tmp_path / "scaled")
    ours = batch_of(spec, [1.0, LENGTH], [1.0, MASS])
    theirs = batch_of(large, [1.0], [1.0])
    assert ours._batch.get_model(1).body_subtreemass[1] == pytest.approx(theirs.model.body_subtreemass[1])
    start = np.concatenate([[0.0, 0.0, large.nominal_height + 0.05, 1.0, 0.0, 0.0, 0.0], spec.default_joint_pos])
    for batch in (ours, theirs):
        n = batch.num_envs
        batch.reset(np.arange(n), np.tile(start, (n, 1)), np.zeros((n, batch.model.nv)))
        for step in range(40):
            noise = np.random.default_rng(step).normal(0.0, 0.3, spec.num_joints)
            batch.step(np.tile(noise, (n, 1)))
    assert theirs.sensordata[0, 14] > 10.0 or theirs.sensordata[0, 17] > 10.0, "it stands on something"
    assert np.allclose(ours.qpos[1], theirs.qpos[0], atol=1e-9)
    assert np.allclose(ours.qvel[1], theirs.qvel[0], atol=1e-7)
    assert np.allclose(ours.sensordata[1], theirs.sensordata[0], rtol=1e-6, atol=1e-6)
    assert not np.allclose(ours.qpos[0], theirs.qpos[0], atol=1e-3), "the neighbour kept its size"


def randomized(**rows: tuple[float, float]) -> HumanoidEnv:
    return make_env(["h1", "g1"], 6, with_randomization(**rows))


def test_constants_of_the_robot_follow_its_size() -> None:
    env = randomized(morphology_length_scale=(0.8, 1.2), morphology_mass_scale=(0.5, 2.0))
    nominal = make_env(["h1", "g1"], 6, BARE).robots
    length, mass = env.robots.nominal_height / nominal.nominal_height, env.robots.total_mass / nominal.total_mass
    for factor, (low, high) in ((length, (0.8, 1.2)), (mass, (0.5, 2.0))):
        assert (factor >= low).all()
        assert (factor <= high).all()
        assert len(factor.unique()) == 6
    torch.testing.assert_close(env.robots.swing_height / nominal.swing_height, length)
    for batch, rows in zip(env.pool.batches, env.pool.rows, strict=True):
        subtree = batch._batch.expanded("body_subtreemass")
        assert subtree is not None
        assert np.allclose(subtree[:, 1], env.robots.total_mass[rows].numpy(), rtol=1e-5)
    soles = env.state.foot_height
    assert soles.abs().max() < 0.045, "in the default pose its soles are at the ground, 4 cm up"
    torch.testing.assert_close(env.state.base_height, env.robots.nominal_height + 0.04)


@pytest.mark.parametrize("descriptor", ["paper", "extended"])
def test_the_embodiment_observation_tells_the_size(descriptor: str) -> None:
    task = with_randomization(morphology_length_scale=(1.1, 1.1), morphology_mass_scale=(0.6, 0.6))
    task = replace(task, observations=replace(ObservationsCfg(), descriptor=descriptor))
    env = make_env(["g1"], 2, task, dtype=torch.float64)
    spec = env.pool.batches[0].spec
    expected = nominal_embodiment(spec) * np.array([0.6] + [1.1] * 3 + [0.6 * 1.1**2] * 6)
    mean, std = reference_statistics()
    assert env.embodiment is not None
    assert np.allclose(env.embodiment[0, :30], (expected.ravel() - mean) / std, atol=1e-6)
    if descriptor == "extended":
        plain = structure_vector(spec)
        told = env.embodiment[0, 30:].numpy()
        assert np.array_equal(told[len(LIMBS) :], plain[len(LIMBS) :])
        metres = [
            x[: len(LIMBS)] * [0.08, 0.05, 0.02, 0.05, 0.05] + [0.36, 0.32, 0.06, 0.24, 0.25] for x in (told, plain)
        ]
        assert np.allclose(metres[0], 1.1 * metres[1], atol=1e-6)


def test_off_by_default_and_then_nothing_is_expanded() -> None:
    cfg = RandomizationCfg()
    assert cfg.morphology_length_scale == cfg.morphology_mass_scale == (1.0, 1.0)
    env = make_env(["h1"], 1)
    assert env.pool.batches[0]._batch.expanded("geom_size") is None


def test_size_is_its_own_stream() -> None:
    """Switching it on moves nobody else's draws."""
    plain = make_env(["h1"], 3, TaskCfg())
    cfg = replace(TaskCfg(), randomization=RandomizationCfg(morphology_length_scale=(0.9, 1.1)))
    large = make_env(["h1"], 3, cfg)
    assert torch.equal(plain.randomizer.friction, large.randomizer.friction)
    assert torch.equal(plain.command, large.command)
    assert np.allclose(field(plain, "body_mass"), field(large, "body_mass"))


def test_a_resumed_run_has_the_same_bodies() -> None:
    task = replace(TaskCfg(), randomization=RandomizationCfg(morphology_length_scale=(0.9, 1.1)))
    first, second = make_env(task=task), make_env(task=task)
    for _ in rollout(first, 10):
        pass
    second.load_state_dict(first.state_dict())
    out = [env.step(actions(4, 10))[0] for env in (first, second)]
    assert_same(out[0], out[1], "resumed with morphology randomization")


def centres(batch: RobotBatch) -> Array:
    """Centres of mass in the world, shape (n, nbody, 3)."""
    positions = batch._batch.bind("xipos")
    batch.refresh(np.arange(batch.num_envs))
    return positions


@pytest.mark.parametrize("name", ["h1", "g1", "t1", "n1", "adam"])
def test_every_centre_of_mass_that_is_moved_moves(name: str) -> None:
    spec = load_robot(name)
    plain, moved = batch_of(spec, [1.0], [1.0]), batch_of(spec, [1.0], [1.0])
    bodies = (1, moved.model.nbody)
    offset = np.zeros((*bodies, 3))
    offset[:, 1:] = 0.01
    moved.change_bodies(np.ones(1), np.ones(bodies), np.zeros(bodies), offset)
    distance = np.linalg.norm(centres(moved)[0, 1:] - centres(plain)[0, 1:], axis=1)
    assert np.allclose(distance, 0.01 * np.sqrt(3.0)), "MuJoCo took a centre for the body's origin"
