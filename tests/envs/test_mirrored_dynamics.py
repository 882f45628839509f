"""A robot's mirror image, told the mirrored commands and actions, moves as the mirror image of the robot.

The vendors' numbers are not exactly symmetric (docs/robots.md lists where), so the shipped robots are made so first:
left and right masses, centres, inertias and joint positions are averaged. The test biped is symmetric as it is.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import envs.humanoid_env
from eagle_rl.config.schema import ControlCfg, SimCfg, TaskCfg
from envs.humanoid_env import HumanoidEnv
from envs.mdp.layout import COMMAND, SLOTS
from envs.mdp.rewards import RewardContext, compute_rewards, reward_factors
from envs.mdp.symmetry import mirror_state
from envs.robots.load import load_robot
from envs.robots.model import build_model
from envs.robots.slots import MIRROR_PERMUTATION, NUM_SLOTS
from envs.robots.spec import Array, RobotSpec
from envs.state import PooledState
from tests.envs.worlds import BARE, robot
from tests.robots.biped import write_biped

FLIP = np.diag([1.0, -1.0, 1.0])
ROBOTS = ("h1", "g1", "t1", "n1", "adam")
TOLERANCES = {False: 1e-9, True: 1e-6}
"""With self-collision off and on: where two limbs press on each other, MuJoCo finds the normal to about 1e-8 only."""
TASK = replace(BARE, aids=TaskCfg().aids, control=ControlCfg(posture_reference=1.0))
"""With harness, gait shaping and legs that bend, which must be symmetric too."""


def partners(model: mujoco.MjModel, spec: RobotSpec) -> Array:
    """Body on the other side of each body, itself if central, shape (nbody,)."""
    bodies = {int(slot): model.joint(name).id + 1 for slot, name in zip(spec.slots, spec.joint_names, strict=True)}
    out = np.arange(model.nbody)
    for slot, body in bodies.items():
        out[body] = bodies[int(MIRROR_PERMUTATION[slot])]
    return out


def symmetrised(model: mujoco.MjModel, spec: RobotSpec) -> mujoco.MjModel:
    """Average every body's numbers with those of its partner's mirror image."""
    other = partners(model, spec)
    assert (model.jnt_bodyid == np.arange(model.njnt) + 1).all()
    rotations = np.zeros((model.nbody, 9))
    for rotation, quat in zip(rotations, model.body_iquat, strict=True):
        mujoco.mju_quat2Mat(rotation, quat)
    turn = rotations.reshape(-1, 3, 3)
    inertia = turn @ (model.body_inertia[:, :, None] * turn.transpose(0, 2, 1))
    inertia = 0.5 * (inertia + FLIP @ inertia[other] @ FLIP)
    model.body_mass[:] = 0.5 * (model.body_mass + model.body_mass[other])
    for positions in (model.body_pos, model.body_ipos):
        positions[:] = 0.5 * (positions + positions[other] @ FLIP)
    for body in range(1, model.nbody):
        moments, axes = np.linalg.eigh(inertia[body])
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        model.body_inertia[body] = moments
        mujoco.mju_mat2Quat(model.body_iquat[body], np.ascontiguousarray(axes).ravel())
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A pair of environments of each robot, by its name and by whether it collides with itself."""
    biped = load_robot(write_biped(tmp_path_factory.mktemp("biped")))
    patch = pytest.MonkeyPatch()
    patch.setattr(envs.humanoid_env, "build_model", lambda spec, *rest: symmetrised(build_model(spec, *rest), spec))
    specs = {name: robot(name) for name in ROBOTS} | {"biped": biped}
    yield {
        (name, contact): HumanoidEnv(
            replace(TASK, sim=SimCfg(self_collision=contact)), [spec], 2, 0, num_threads=1, dtype=torch.float64
        )
        for name, spec in specs.items()
        for contact in TOLERANCES
    }
    patch.undo()


def mirrored(x: Tensor, mirror: Any) -> Tensor:
    return x[..., list(mirror.perm)] * x.new_tensor(mirror.sign)


def put(env: HumanoidEnv, seed: int) -> Tensor:
    """Give the first environment a random state near standing, the second its mirror image; return such actions."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int, scale: float = 1.0) -> Tensor:
        return scale * torch.randn(*shape, generator=generator, dtype=torch.float64)

    robots = env.robots
    live = robots.slot_mask[0]
    quat = torch.nn.functional.normalize(torch.tensor([1.0, 0.0, 0.0, 0.0]).double() + normal(4, scale=0.1), dim=0)
    height = robots.nominal_height[:1] + normal(1, scale=0.02)
    root = torch.cat([normal(2), height, quat, normal(6, scale=0.5)])
    flips = root.new_tensor([1, -1, 1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1])
    joint_pos = (robots.default_joint_pos[0] + normal(NUM_SLOTS, scale=0.15)) * live
    joint_pos = joint_pos.clamp(robots.joint_soft_lower[0], robots.joint_soft_upper[0])
    joint_vel, action = normal(NUM_SLOTS, scale=2.0) * live, normal(NUM_SLOTS) * live

    def both(x: Tensor) -> Tensor:
        return torch.stack([x, mirrored(x, SLOTS)])

    env.reset()
    env.pool.place(env._all, torch.stack([root, root * flips]), both(joint_pos), both(joint_vel))
    env.pool.restage(env._all, env.pool.staging_rows(env._all))
    command = normal(5, scale=0.4)
    env.commands.pin(torch.stack([command, mirrored(command, COMMAND)]))
    phase = torch.rand(1, generator=generator, dtype=torch.float64)
    env.phase = torch.cat([phase, (phase + 0.5) % 1.0])
    env._actions, env._last_actions = both(normal(NUM_SLOTS) * live), both(normal(NUM_SLOTS) * live)
    env._forget()
    return both(action)


def assert_mirrored(state: PooledState, env: HumanoidEnv, tolerance: float) -> None:
    first, second = (state.rows(torch.tensor([row])) for row in (0, 1))
    image = mirror_state(first, env.task.observations)
    scale = {"joint_acc": 1e3, "joint_torque": 1e2, "foot_force_w": 1e4, "link_force_w": 1e4}
    for name in (f.name for f in fields(state)):
        ours, theirs = getattr(image, name), getattr(second, name)
        if ours.dtype == torch.bool:
            assert torch.equal(ours, theirs), name
        else:
            error = (ours - theirs).abs().max().item() / scale.get(name, 1.0)
            assert error < tolerance, f"{name} is off by {error:.1e} of its size"


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000))
@pytest.mark.parametrize("self_collision", TOLERANCES)
@pytest.mark.parametrize("name", [*ROBOTS, "biped"])
def test_a_mirrored_step_ends_in_the_mirrored_state_with_the_same_reward(
    twins: Any, name: str, self_collision: bool, seed: int
) -> None:
    env: HumanoidEnv = twins[name, self_collision]
    tolerance = TOLERANCES[self_collision]
    command = put(env, seed)
    assert_mirrored(env.state, env, tolerance)
    seen: list[PooledState] = []
    derive = env._derive
    env._derive = lambda *rows: seen.append(derive(*rows)) or seen[-1]  # type: ignore[method-assign]
    observations, rewards, dones, _ = env.step(command)
    env._derive = derive  # type: ignore[method-assign]
    state = seen[0]
    assert_mirrored(state, env, tolerance)
    assert dones[0] == dones[1]
    context = RewardContext(
        cfg=env.task.rewards,
        gait=env.task.gait,
        gait_shaping=torch.ones(2, dtype=torch.float64),
        terminated=torch.zeros(2, dtype=torch.bool),
    )
    total, terms = compute_rewards(
        state, env.robots, context, reward_factors(context.cfg.weights, 1.0, env.step_dt, state.joint_pos)
    )
    for term, value in terms.items():
        assert abs(value[0] - value[1]) < tolerance, term
    assert abs(total[0] - total[1]) < tolerance
    assert rewards[0].item() == pytest.approx(rewards[1].item(), abs=1e-6)
    if not dones.any():
        for group in ("history", "command", "clock", "critic"):
            perm, sign = env.mirror[group]
            image, seen_by_twin = observations[group][0, perm] * sign, observations[group][1]
            if group == "critic":  # o_ea is read from the URDF, which is not averaged
                embodiment = env.layout.columns("critic", "embodiment")
                image, seen_by_twin = image[: embodiment.start], seen_by_twin[: embodiment.start]
            assert torch.allclose(image, seen_by_twin, atol=1e-5), group


def test_left_and_right_of_the_shipped_robots_do_differ() -> None:
    """Else the averaging above would be idle."""
    for name in ROBOTS:
        model = build_model(robot(name), TASK.sim)
        before = [np.array(x) for x in (model.body_mass, model.body_ipos, model.body_inertia)]
        after = symmetrised(build_model(robot(name), TASK.sim), robot(name))
        assert any(
            not np.allclose(a, b, rtol=1e-9) for a, b in zip(before, (after.body_mass, after.body_ipos), strict=False)
        )


def test_averaging_leaves_a_symmetric_robot_alone(tmp_path: Path) -> None:
    spec = load_robot(write_biped(tmp_path))
    plain, averaged = build_model(spec, TASK.sim), symmetrised(build_model(spec, TASK.sim), spec)
    for name in ("body_mass", "body_pos", "body_ipos", "body_subtreemass", "dof_invweight0"):
        assert np.allclose(getattr(plain, name), getattr(averaged, name), rtol=1e-12, atol=1e-15), name
