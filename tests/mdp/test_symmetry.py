from __future__ import annotations

from dataclasses import fields

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from eagle_rl.config.schema import ObservationsCfg
from envs.geometry import rotate_inverse
from envs.mdp.layout import ObservationLayout
from envs.mdp.symmetry import mirror_robots, mirror_state
from envs.robots.slots import SLOT_INDEX
from envs.robots.spec import COLLISION_LINKS
from tests.states import random_robots, random_state

CFG = ObservationsCfg()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_mirroring_twice_gives_state_and_robot_back(seed: int) -> None:
    robots = random_robots(seed)
    state = random_state(seed, robots)
    for once, twice in (
        (state, mirror_state(mirror_state(state, CFG), CFG)),
        (robots, mirror_robots(mirror_robots(robots))),
    ):
        for f in fields(once):
            assert torch.equal(getattr(once, f.name), getattr(twice, f.name)), f.name


def test_every_quantity_but_the_symmetric_ones_changes() -> None:
    robots = random_robots(0)
    state = random_state(0, robots)
    mirrored = mirror_state(state, CFG)
    kept = {f.name for f in fields(state) if torch.equal(getattr(state, f.name), getattr(mirrored, f.name))}
    assert kept == {"base_height", "ground_contact", "friction", "standing"}


def test_mirrored_orientation_agrees_with_mirrored_vectors() -> None:
    """Expressing a mirrored vector in the mirrored frame mirrors its components."""
    state = random_state(3, random_robots(3))
    mirrored = mirror_state(state, CFG)
    y = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    seen = rotate_inverse(state.root_quat_w, state.foot_force_w[:, 0])
    reflected = rotate_inverse(mirrored.root_quat_w, mirrored.foot_force_w[:, 1])
    assert torch.allclose(reflected, seen * y)
    assert torch.allclose(mirrored.heading_w, state.heading_w * torch.tensor([1.0, -1.0]))
    assert torch.allclose(mirrored.base_roll, -state.base_roll)
    assert torch.allclose(mirrored.base_pitch, state.base_pitch)


def test_the_cross_product_of_mirrored_vectors_is_the_mirrored_angular_velocity() -> None:
    """Velocities flip along y, angular velocities along x and z: a turn to the left becomes one to the right."""
    state = random_state(5, random_robots(5))
    state.base_ang_vel_b = torch.linalg.cross(state.base_lin_vel_b, state.projected_gravity_b)
    mirrored = mirror_state(state, CFG)
    expected = torch.linalg.cross(mirrored.base_lin_vel_b, mirrored.projected_gravity_b)
    assert torch.allclose(mirrored.base_ang_vel_b, expected)
    sign = ObservationLayout(CFG).mirror()["history"][1]
    assert sign[:3].tolist() == [-1.0, 1.0, -1.0]


def test_limbs_and_links_change_sides() -> None:
    robots = random_robots(0)
    state = random_state(0, robots)
    state.joint_pos = torch.arange(32.0, dtype=torch.float64).expand_as(state.joint_pos) + 1.0
    mirrored = mirror_state(state, CFG)
    left, right = SLOT_INDEX["left_hip_roll"], SLOT_INDEX["right_hip_roll"]
    assert torch.equal(mirrored.joint_pos[:, left], -state.joint_pos[:, right])
    left, right = SLOT_INDEX["left_elbow_pitch"], SLOT_INDEX["right_elbow_pitch"]
    assert torch.equal(mirrored.joint_pos[:, right], state.joint_pos[:, left])
    link, other = COLLISION_LINKS.index("left_knee"), COLLISION_LINKS.index("right_knee")
    assert torch.equal(mirrored.link_force_w[:, link, 2], state.link_force_w[:, other, 2])


def test_mirrored_limits_stay_ordered_and_keep_the_joint_inside() -> None:
    robots = random_robots(4)
    mirrored = mirror_robots(robots)
    assert (mirrored.joint_soft_lower <= mirrored.default_joint_pos).all()
    assert (mirrored.default_joint_pos <= mirrored.joint_soft_upper).all()
