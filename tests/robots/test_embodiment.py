"""o_ea says what the body is: against closed forms, against MuJoCo, and under randomization and mirror."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from eagle_rl.config.schema import SimCfg
from envs.mdp.layout import EMBODIMENT
from envs.robots.embodiment import (
    EMBODIMENT_LINKS,
    LINK_DIM,
    REFERENCE_ROBOTS,
    BodyChanges,
    embodiment_dim,
    embodiment_vector,
    mirrored,
    nominal_embodiment,
    pooled_embodiment,
    reference_statistics,
)
from envs.robots.load import load_robot
from envs.robots.model import build_model
from envs.robots.spec import Array
from envs.robots.structure import LIMBS, STRUCTURE_DIM, limb_lengths, structure_mirror, structure_vector
from envs.robots.urdf import read_urdf

from .biped import BOXES, JOINTS, SOLE_Z, box_moments, write_biped
from .vendor import ROBOTS, shipped

robots = pytest.mark.parametrize("name", ROBOTS)


def _changes(rows: int, seed: int | None = None) -> BodyChanges:
    draw = torch.Generator().manual_seed(seed or 0)
    if seed is None:
        scale, added = (torch.full((rows, 3), v, dtype=torch.float64) for v in (1, 0))
        return BodyChanges(torch.ones(rows, dtype=torch.float64), scale, added, torch.zeros(rows, 3, 3))
    scale, added = (torch.rand(rows, 3, generator=draw, dtype=torch.float64) for _ in range(2))
    offset = torch.rand(rows, 3, 3, generator=draw, dtype=torch.float64) - 0.5
    length = 0.8 + 0.4 * torch.rand(rows, generator=draw, dtype=torch.float64)
    return BodyChanges(length, 0.8 + 0.4 * scale, 3.0 * added, 0.02 * offset)


def test_boxes_have_their_textbook_mass_centre_and_inertia(tmp_path: Path) -> None:
    rows = nominal_embodiment(load_robot(write_biped(tmp_path)))
    for row, link in zip(rows, ("torso", "foot", "foot"), strict=True):
        mass, size, centre = BOXES[link]
        np.testing.assert_allclose(row, [mass, *centre, *box_moments(mass, size), 0.0, 0.0, 0.0], atol=1e-12)


def test_rigidly_attached_links_count(tmp_path: Path) -> None:
    """A second box bolted 0.5 m above the torso's: masses add, the centre moves, Steiner's rule gives the inertia."""
    extra = (
        '<link name="pack"><inertial><mass value="2"/>'
        '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="pack_joint" type="fixed"><parent link="torso"/><child link="pack"/>'
        '<origin xyz="0 0 0.75"/></joint></robot>'
    )
    path = write_biped(tmp_path)
    urdf = tmp_path / "biped.urdf"
    urdf.write_text(urdf.read_text().replace("</robot>", extra))
    torso = nominal_embodiment(load_robot(path))[0]
    mass, size, _ = BOXES["torso"]
    ixx, iyy, izz = box_moments(mass, size)
    steiner = mass * 2.0 / (mass + 2.0) * 0.5**2
    centre = (mass * 0.25 + 2.0 * 0.75) / (mass + 2.0)
    expected = [mass + 2.0, 0.0, 0.0, centre, ixx + 0.01 + steiner, iyy + 0.01 + steiner, izz + 0.01, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(torso, expected, atol=1e-12)


@robots
def test_nominal_values_are_mujocos(name: str) -> None:
    spec = shipped(name)
    np.testing.assert_allclose(nominal_embodiment(spec), _from_mujoco(build_model(spec, SimCfg()), name), atol=1e-9)


@robots
def test_randomized_values_are_those_the_physics_uses(name: str) -> None:
    """Change the compiled model as the simulation does and read o_ea back from it."""
    spec = shipped(name)
    changes = _changes(1, seed=3)
    model = build_model(spec, SimCfg())
    for i, role in enumerate(EMBODIMENT_LINKS):
        body = model.body(spec.link_roles[role])
        body.mass = body.mass * float(changes.mass_scale[0, i]) + float(changes.added_mass[0, i])
        body.inertia = body.inertia * float(changes.mass_scale[0, i]) * float(changes.length_scale[0]) ** 2
        body.ipos = body.ipos * float(changes.length_scale[0]) + changes.com_offset[0, i].numpy()
    nominal = torch.from_numpy(nominal_embodiment(spec)).unsqueeze(0)
    ours = embodiment_vector(nominal, changes).reshape(3, LINK_DIM)
    np.testing.assert_allclose(ours, _from_mujoco(model, name), atol=1e-9)


def _from_mujoco(model: mujoco.MjModel, name: str) -> Array:
    rows = []
    for role in EMBODIMENT_LINKS:
        body = model.body(shipped(name).link_roles[role])
        rot = np.zeros(9)
        mujoco.mju_quat2Mat(rot, body.iquat)
        tensor = rot.reshape(3, 3) @ np.diag(body.inertia) @ rot.reshape(3, 3).T
        rows.append([*body.mass, *body.ipos, *np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]])
    return np.array(rows)


def test_pool_rows_follow_robot_dtype_and_size() -> None:
    specs = [shipped(name) for name in ("g1", "h1")]
    robot_id = torch.tensor([1, 0, 1])
    for descriptor, extra in (("paper", 0), ("extended", STRUCTURE_DIM)):
        rows = pooled_embodiment(specs, robot_id, _changes(3), descriptor)
        assert rows.shape == (3, embodiment_dim(descriptor)) == (3, 30 + extra)
        assert rows.dtype == torch.float64
        assert torch.equal(rows[0], rows[2])
        assert not torch.allclose(rows[0], rows[1])


def test_default_randomization_of_all_five_robots_is_standardised() -> None:
    """Over many draws of the default ranges each channel has mean about 0 and deviation of at most about 1."""
    count = 4000
    draw = torch.Generator().manual_seed(1)
    uniform = torch.rand(5 * count, 3, 5, generator=draw, dtype=torch.float64)
    scale, offset = 0.8 + 0.4 * uniform[..., 0], 0.02 * (uniform[..., 1:4] - 0.5)
    added = torch.zeros_like(scale)
    specs = [shipped(name) for name in REFERENCE_ROBOTS]
    base = [i for i, spec in enumerate(specs) if spec.link_roles["torso"] == spec.base_link]
    robot_id = torch.arange(5).repeat(count)
    for i in base:
        rows = robot_id == i
        added[rows, 0] = specs[i].total_mass * (-0.058 + 0.232 * uniform[rows, 0, 4])
    rows = pooled_embodiment(specs, robot_id, BodyChanges(torch.ones(5 * count), scale, added, offset), "paper")
    assert rows.mean(dim=0).abs().max() < 0.1
    std = rows.std(dim=0)
    assert std.max() < 1.05
    assert std[[0, 1, 3, 4, 5, 6, 10, 11, 13, 14, 15, 16]].min() > 0.85, "mass, centre and moments carry information"


def test_standardisation_commutes_with_the_mirror() -> None:
    mean, std = (x.reshape(3, LINK_DIM) for x in reference_statistics())
    np.testing.assert_allclose(mirrored(mean, sign=True), mean, atol=1e-15)
    np.testing.assert_allclose(mirrored(std, sign=False), std, rtol=1e-12)
    assert std.min() > 0.0


def test_the_observations_mirror_is_that_of_the_body() -> None:
    values = np.arange(1.0, 31.0).reshape(3, LINK_DIM)
    layout = EMBODIMENT["paper"]
    ours = mirrored(values, sign=True).ravel()
    np.testing.assert_array_equal(values.ravel()[list(layout.perm)] * np.array(layout.sign), ours)
    assert len(EMBODIMENT["extended"].perm) == embodiment_dim("extended")


@robots
def test_structure_is_its_own_mirror_image(name: str) -> None:
    spec = shipped(name)
    vector = structure_vector(spec)
    perm, sign = structure_mirror()
    assert vector.shape == (STRUCTURE_DIM,)
    np.testing.assert_allclose(vector[list(perm)] * np.array(sign), vector, atol=1e-4)
    assert sorted(perm) == list(range(STRUCTURE_DIM))


def test_structure_tells_robots_and_joint_orders_apart() -> None:
    vectors = {name: structure_vector(shipped(name)) for name in ROBOTS}
    for a in ROBOTS:
        for b in ROBOTS:
            assert a == b or np.abs(vectors[a] - vectors[b]).max() > 0.1


def test_limb_lengths_of_a_known_robot(tmp_path: Path) -> None:
    spec = load_robot(write_biped(tmp_path))
    tree = read_urdf(spec.urdf_path)
    lengths = dict(zip(LIMBS, limb_lengths(spec, tree, tree.forward(spec.default_joint_pos)), strict=True))
    thigh, shank, arm = (-JOINTS[child][2][2] for child in ("shank", "foot", "forearm"))
    forearm = -BOXES["forearm"][2][2]
    foot = float(np.hypot(0.03, SOLE_Z))
    assert lengths == pytest.approx(
        {"thigh": thigh, "shank": shank, "foot": foot, "upper_arm": arm, "forearm": forearm}, abs=1e-12
    )
