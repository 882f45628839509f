"""Every row of the randomization table: in its range, per environment, and off when it is off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from eagle_rl.config.schema import RandomizationCfg, TaskCfg
from envs.humanoid_env import HumanoidEnv
from envs.robots.embodiment import embodiment_vector, nominal_embodiment
from envs.robots.spec import Array
from tests.envs.worlds import BARE, actions, assert_same, make_env, robot, rollout, with_randomization

NUM_ENVS = 64


def field(env: HumanoidEnv, name: str) -> Array:
    """A model field of the first robot, per environment, shape (n, ...)."""
    batch = env.pool.batches[0]
    expanded = batch._batch.expanded(name)
    return (
        np.broadcast_to(getattr(batch.model, name), (batch.num_envs, *getattr(batch.model, name).shape))
        if (expanded is None)
        else expanded
    )


def readings(env: HumanoidEnv) -> dict[str, Array]:
    """What each row of the table acts on, as measured in the physics, per environment."""
    batch, model = env.pool.batches[0], env.pool.batches[0].model
    base = model.body(batch.spec.base_link).id
    rest = np.arange(model.nbody) > base
    floor = model.geom("floor").id
    kp, kd = field(env, "actuator_gainprm")[:, :, 0], field(env, "dof_damping")[:, 6:]
    rows = env.pool.rows[0]
    offset = field(env, "body_ipos") - model.body_ipos
    return {
        "friction": field(env, "geom_friction")[:, floor, 0],
        "stiffness": kp / batch.spec.stiffness,
        "damping": kd / batch.spec.damping,
        "link_mass": field(env, "body_mass")[:, rest] / model.body_mass[rest],
        "link_com": offset[:, rest],
        "base_mass": field(env, "body_mass")[:, base] - model.body_mass[base],
        "base_com": offset[:, base],
        "motor_offset": env.randomizer.motor_offset[rows].numpy(),
        "latency": env.randomizer.latency[rows].numpy(),
        "joint_pos": batch.qpos[:, 7:] - batch.spec.default_joint_pos,
        "joint_vel": batch.qvel[:, 6:],
        "root_vel": batch.qvel[:, :6],
    }


NOMINAL = {"friction": 1.0, "stiffness": 1.0, "damping": 1.0, "link_mass": 1.0}
ROWS = {  # key in the configuration: (range, what it moves and between which bounds)
    "friction": ((0.6, 0.9), {"friction": (0.6, 0.9)}),
    "stiffness_scale": ((0.7, 1.4), {"stiffness": (0.7, 1.4)}),
    "damping_scale": ((0.7, 1.4), {"damping": (0.7, 1.4)}),
    "strength_scale": ((0.7, 1.4), {"stiffness": (0.7, 1.4), "damping": (0.7, 1.4)}),
    "motor_offset": ((-0.03, 0.05), {"motor_offset": (-0.03, 0.05)}),
    "sensing_latency_s": ((0.005, 0.015), {"latency": (0.25, 0.75)}),
    "link_mass_scale": ((0.7, 1.4), {"link_mass": (0.7, 1.4), "base_mass": (-20.0, 20.0)}),
    "link_com_offset": ((-0.02, 0.03), {"link_com": (-0.02, 0.03), "base_com": (-0.02, 0.03)}),
    "base_mass_ratio": ((0.1, 0.2), {"base_mass": (5.1, 10.4)}),
    "base_com_offset": ((0.01, 0.05), {"base_com": (0.0, 0.05)}),
    "init_joint_scale": ((0.5, 1.5), {"joint_pos": (-1.0, 1.0)}),
    "init_joint_vel": ((-2.0, 1.0), {"joint_vel": (-2.0, 2.0)}),
    "init_root_vel": ((-0.1, 0.3), {"root_vel": (-0.1, 0.3)}),
}


@pytest.mark.parametrize("row", ROWS)
def test_each_row_moves_its_own_quantity_and_nothing_else(row: str) -> None:
    bounds, moved = ROWS[row]
    env = make_env(["h1"], NUM_ENVS, with_randomization(**{row: bounds}))
    for name, values in readings(env).items():
        deviation = np.abs(values - NOMINAL.get(name, 0.0))
        if name not in moved:
            assert deviation.max() < 1e-6, f"{row} moved {name}"
            continue
        low, high = moved[name]
        assert (values >= low - 1e-6).all(), name
        assert (values <= high + 1e-6).all(), name
        per_env = values.reshape(NUM_ENVS, -1)
        assert len(np.unique(per_env, axis=0)) == NUM_ENVS, f"{name} is not drawn per environment"


@pytest.mark.parametrize("row", ["friction", "stiffness_scale", "link_mass_scale", "motor_offset", "init_root_vel"])
def test_draws_fill_their_range(row: str) -> None:
    bounds, moved = ROWS[row]
    values = readings(make_env(["h1"], NUM_ENVS, with_randomization(**{row: bounds})))[next(iter(moved))]
    values = values[values != 0.0]
    span = bounds[1] - bounds[0]
    assert values.min() < bounds[0] + 0.1 * span
    assert values.max() > bounds[1] - 0.1 * span
    assert values.mean() == pytest.approx(sum(bounds) / 2, abs=5 * span / np.sqrt(12 * NUM_ENVS))


def test_the_master_switch_leaves_the_nominal_robot() -> None:
    env = make_env(["h1"], 3, BARE)
    for name, values in readings(env).items():
        assert np.allclose(values, NOMINAL.get(name, 0.0), atol=1e-6), name


def test_pushes_come_at_their_interval_and_only_when_switched_on() -> None:
    off = with_randomization()
    on = with_randomization(push_lin_vel=1.0, push_interval_s=0.1)
    assert not pushed_steps(off)
    assert pushed_steps(on) == [4, 9]


def pushed_steps(task: TaskCfg) -> list[int]:
    """Steps after which the robots differ from undisturbed ones for the first time since they were set equal."""
    env, twin = make_env(["h1"], 4, task), make_env(["h1"], 4, with_randomization())
    steps = []
    for step in range(12):
        env.pool.batches[0].set_state(twin.pool.batches[0].state())
        env.step(actions(4, step))
        twin.step(actions(4, step))
        difference = np.abs(env.pool.batches[0].qvel - twin.pool.batches[0].qvel).max()
        assert difference == 0.0 or difference > 1e-3
        if difference:
            steps.append(step)
    return steps


def test_new_gains_are_drawn_for_every_episode_but_bodies_stay() -> None:
    env = make_env(["h1"], 4)
    before = {name: values.copy() for name, values in readings(env).items()}
    env._reset(torch.tensor([1, 2]), torch.tensor([False, False]))
    after = readings(env)
    for name in ("friction", "stiffness", "damping", "motor_offset", "latency"):
        same = (before[name] == after[name]).reshape(4, -1).all(axis=1)
        assert same.tolist() == [True, False, False, True], name
    for name in ("link_mass", "link_com", "base_mass", "base_com"):
        assert np.array_equal(before[name], after[name]), name


def test_lagging_sensors_blend_the_last_two_frames() -> None:
    late = make_env(["h1"], 2, with_randomization(sensing_latency_s=(0.005, 0.005)))
    sharp = make_env(["h1"], 2, with_randomization())
    previous = sharp.get_observations()["history"][:, :102]
    for (first, _), (second, _) in zip(rollout(late, 5), rollout(sharp, 5), strict=True):
        now = second["history"][:, :102]
        blend = 0.75 * now + 0.25 * previous
        torch.testing.assert_close(first["history"][:, :70], blend[:, :70])
        assert torch.equal(first["history"][:, 70:102], now[:, 70:]), "the last action is not sensed"
        assert torch.equal(first["critic"], second["critic"]), "the critic's view is never late"
        previous = now


def test_sensor_noise_is_bounded_and_spares_the_critic() -> None:
    noisy_cfg = replace(BARE, observations=replace(BARE.observations, enable_corruption=True))
    noisy, clean = make_env(["h1"], 4, noisy_cfg), make_env(["h1"], 4, BARE)
    scales, bounds = BARE.observations.scales, BARE.observations.noise
    half = torch.tensor(
        [bounds.base_ang_vel * scales.base_ang_vel] * 3
        + [bounds.projected_gravity * scales.projected_gravity] * 3
        + [bounds.joint_pos * scales.joint_pos] * 32
        + [bounds.joint_vel * scales.joint_vel] * 32
        + [0.0] * 32
    )
    live = torch.cat([torch.ones(6), *[noisy.robots.slot_mask[0]] * 3])
    for (first, _), (second, _) in zip(rollout(noisy, 20), rollout(clean, 20), strict=True):
        noise = (first["history"] - second["history"])[:, :102]
        assert (noise.abs() <= half * live + 1e-6).all()
        assert (noise.abs().amax(dim=0) > 0)[(half * live) > 0].all()
        assert torch.equal(first["critic"], second["critic"])


def test_the_embodiment_observation_tells_the_true_bodies() -> None:
    env = make_env(["g1"], 5)
    batch, model = env.pool.batches[0], env.pool.batches[0].model
    nominal = torch.as_tensor(nominal_embodiment(robot("g1"))).float()
    told = embodiment_vector(nominal.expand(5, -1, -1), env.randomizer.bodies).reshape(5, 3, 10)
    for row, role in enumerate(("torso", "left_foot", "right_foot")):
        body = model.body(batch.spec.link_roles[role]).id
        mass, com = field(env, "body_mass")[:, body], field(env, "body_ipos")[:, body]
        assert np.allclose(told[:, row, 0], mass, rtol=1e-5), role
        assert np.allclose(told[:, row, 1:4], com, atol=1e-6), role
        moments = field(env, "body_inertia")[:, body].sum(axis=1)
        assert np.allclose(told[:, row, 4:7].sum(dim=1), moments, rtol=1e-4), role


def test_adding_a_robot_moves_nobody_elses_draws() -> None:
    alone, company = make_env(["g1"], 3), make_env(["h1", "g1"], 6)
    first, second = alone.get_observations(), company.get_observations()[3:]
    for group in ("history", "critic", "estimate", "command"):
        assert torch.equal(first[group], second[group]), group


def test_the_seed_decides_everything() -> None:
    assert_same(make_env(seed=4).get_observations(), make_env(seed=4).get_observations(), "same seed")
    assert not torch.equal(make_env(seed=4).get_observations()["critic"], make_env(seed=5).get_observations()["critic"])


def test_defaults_are_the_table_of_the_facts() -> None:
    cfg = RandomizationCfg()
    assert cfg.friction == (0.55, 1.875)
    assert cfg.stiffness_scale == cfg.damping_scale == cfg.strength_scale == cfg.link_mass_scale == (0.8, 1.2)
    assert cfg.base_mass_ratio == (-0.058, 0.174)
    assert (cfg.push_interval_s, cfg.push_lin_vel, cfg.push_ang_vel) == (5.0, 0.6, 0.6)
