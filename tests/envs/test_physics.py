"""RobotBatch and PhysicsPool against plain MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from eagle_rl.config.schema import SimCfg
from envs.robots.model import build_model
from envs.robots.sensors import SENSOR_SLICES
from envs.robots.spec import Array
from envs.sim.batch import RobotBatch
from envs.sim.pool import PhysicsPool
from tests.envs.worlds import robot

SIM = SimCfg()
NUM_ENVS, STEPS = 3, 40


def make_batch(name: str, num_envs: int = NUM_ENVS) -> RobotBatch:
    spec = robot(name)
    return RobotBatch(spec, build_model(spec, SIM), num_envs, SIM.decimation)


def targets(batch: RobotBatch, step: int) -> Array:
    noise = np.random.default_rng(step).normal(0.0, 0.2, (batch.num_envs, batch.spec.num_joints))
    return batch.spec.default_joint_pos + noise


@pytest.mark.parametrize("name", ["h1", "n1"])
def test_a_batch_is_a_plain_loop_over_mj_step(name: str) -> None:
    batch = make_batch(name)
    for step in range(STEPS):
        batch.step(targets(batch, step))
    for env in range(NUM_ENVS):
        data = mujoco.MjData(batch.model)
        mujoco.mj_resetDataKeyframe(batch.model, data, 0)
        mujoco.mj_forward(batch.model, data)
        for step in range(STEPS):
            data.ctrl[:] = targets(batch, step)[env]
            mujoco.mj_step(batch.model, data, SIM.decimation)
        assert np.array_equal(data.qpos, batch.qpos[env])
        assert np.array_equal(data.qvel, batch.qvel[env])
        assert np.allclose(batch.actuator_force[env], data.actuator_force)
        mujoco.mj_step1(batch.model, data)
        kinematic = slice(SENSOR_SLICES["sole_pos"].start, SENSOR_SLICES["sole_vel"].stop)
        assert np.array_equal(data.sensordata[kinematic], batch.sensordata[env, kinematic]), "sensors lag the state"


def test_resetting_some_leaves_the_others_alone() -> None:
    batch = make_batch("t1")
    for step in range(10):
        batch.step(targets(batch, step))
    before, sensors = batch.state(), batch.sensordata.copy()
    spec = batch.spec
    qpos = np.concatenate([[0.3, 0.1, spec.nominal_height, 1.0, 0.0, 0.0, 0.0], spec.default_joint_pos])
    batch.reset(np.array([1]), qpos[None], np.zeros((1, batch.model.nv)))
    assert np.array_equal(batch.qpos[1], qpos)
    assert np.array_equal(batch.state()[[0, 2]], before[[0, 2]])
    assert np.array_equal(batch.sensordata[[0, 2]], sensors[[0, 2]])
    fresh = make_batch("t1", num_envs=1)
    fresh.reset(np.array([0]), qpos[None], np.zeros((1, batch.model.nv)))
    batch.step(np.tile(spec.default_joint_pos, (NUM_ENVS, 1)))
    fresh.step(spec.default_joint_pos[None])
    assert np.array_equal(batch.qpos[1], fresh.qpos[0]), "warm start, forces or time survived the reset"


def test_a_restored_state_continues_bit_for_bit() -> None:
    first, second = make_batch("h1"), make_batch("h1")
    for step in range(10):
        first.step(targets(first, step))
    second.set_state(first.state())
    for step in range(10, 20):
        first.step(targets(first, step))
        second.step(targets(second, step))
    assert np.array_equal(first.state(), second.state())


def make_pool(*names: str, num_envs: int = 2, threads: int = 1) -> PhysicsPool:
    robots = [(robot(name), build_model(robot(name), SIM), num_envs) for name in names]
    return PhysicsPool(robots, SIM.decimation, torch.device("cpu"), torch.float64, threads)


def test_the_pool_gathers_canonical_angles_into_slots() -> None:
    pool = make_pool("h1", "t1")
    pooled = torch.randn(4, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.1
    for _ in range(5):
        staged = pool.step(pooled)
    for batch, rows in zip(pool.batches, pool.rows, strict=True):
        spec, block = batch.spec, staged[rows].numpy()
        assert np.array_equal(batch.ctrl, spec.to_native(pooled[rows].numpy())), "targets"
        assert np.array_equal(block[:, pool.columns["root_pos"]], batch.qpos[:, :3])
        assert np.array_equal(block[:, pool.columns["sensors"]], batch.sensordata)
        joint_pos = block[:, pool.columns["joint_pos"]]
        assert np.allclose(spec.to_native(joint_pos), batch.qpos[:, 7:])
        assert not joint_pos[:, ~spec.slot_mask].any(), "absent slots"
        assert np.allclose(block[:, pool.columns["joint_vel"]], spec.to_slots(spec.signs * batch.qvel[:, 6:]))
        torque = batch.actuator_force - spec.damping * batch.qvel[:, 6:]
        assert np.allclose(block[:, pool.columns["joint_torque"]], spec.to_slots(spec.signs * torque))


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_side_by_side_give_the_same_bits_as_one(threads: int) -> None:
    pools = [make_pool("h1", "t1", "n1", num_envs=9, threads=count) for count in (1, threads)]
    assert len(pools[0].batches) == 3
    assert len(pools[1].batches) == 6, "nine simulations make two batches"
    generator = torch.Generator().manual_seed(0)
    for step in range(10):
        goal = 0.3 * torch.randn(27, 32, generator=generator, dtype=torch.float64)
        goal[8, 0] = torch.nan if step == 5 else 0.0
        wrench = torch.randn(27, 6, generator=generator, dtype=torch.float64)
        one, other = (pool.step(goal, wrench) for pool in pools)
        assert torch.equal(one, other), f"step {step}"
        assert torch.equal(*(pool.causes for pool in pools))
        assert bool(pools[0].causes[8]) == (step == 5)


def test_the_torque_is_that_of_the_gains_in_force() -> None:
    pool = make_pool("h1", "t1")
    scales = 1.0 + torch.rand(2, 2, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pool.scale_gains(torch.tensor([1, 2]), *scales)
    staged = pool.step(torch.zeros(4, 32, dtype=torch.float64))[:, pool.columns["joint_torque"]]
    scales = torch.cat((torch.ones(2, 1, 32), scales, torch.ones(2, 1, 32)), dim=1).numpy()
    for batch, rows in zip(pool.batches, pool.rows, strict=True):
        spec = batch.spec
        kp, kd = scales[:, rows][..., spec.slots] * np.stack((spec.stiffness, spec.damping))[:, None]
        assert np.array_equal(batch._batch.expand("actuator_gainprm")[:, :, 0], kp)
        torque = batch.actuator_force - kd * batch.qvel[:, 6:]
        assert np.allclose(staged[rows].numpy(), spec.to_slots(spec.signs * torque))


def test_pool_rows_are_split_by_batch() -> None:
    pool = make_pool("h1", "t1", "n1")
    parts = [(robot, local.tolist(), at.tolist()) for robot, local, at in pool.split(torch.tensor([1, 4, 5]))]
    assert parts == [(0, [1], [0]), (2, [0, 1], [1, 2])]
    assert pool.split(torch.tensor([], dtype=torch.long)) == []


def test_staged_rows_handed_out_are_not_written_again() -> None:
    pool = make_pool("h1")
    zeros = torch.zeros(2, 32, dtype=torch.float64)
    staged = pool.step(zeros)
    copy = staged.clone()
    pool.step(zeros)
    assert torch.equal(staged, copy)


def test_a_push_adds_velocity_to_the_bases_it_names() -> None:
    pool = make_pool("h1", "t1")
    before = pool.staged
    linear, angular = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[4.0, 5.0, 6.0]])
    pool.push(torch.tensor([2]), linear.double(), angular.double())
    assert pool.batches[1].qvel[0, :6].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert not pool.batches[0].qvel[:, :6].any()
    assert torch.equal(before, pool.staged)
