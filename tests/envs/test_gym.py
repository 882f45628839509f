"""The gymnasium registration keeps gymnasium's contracts."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import envs.gym
from eagle_rl.errors import ConfigError, RobotError
from envs.gym import ACTION_UNIT, ENV_ID
from envs.rendering.offscreen import gl_backends


def make_vec(num_envs, robots):
    return gymnasium.make_vec(
        ENV_ID, num_envs=num_envs, vectorization_mode="vector_entry_point", robots=robots, num_threads=1
    )


def test_a_single_robot_passes_the_environment_checker():
    env = gymnasium.make(ENV_ID, robots=["t1"], disable_env_checker=True)
    check_env(env.unwrapped, skip_render_check=not gl_backends())
    env.close()


def test_a_vector_environment_passes_its_own_spaces_and_declares_its_resets():
    env = make_vec(5, ["h1", "g1"])
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env.action_space.seed(0)
    observation, info = env.reset(seed=1)
    assert observation in env.observation_space
    assert info["critic"].shape[0] == 5
    observation, rewards, terminations, truncations, _ = env.step(env.action_space.sample())
    assert observation in env.observation_space
    assert rewards.shape == terminations.shape == truncations.shape == (5,)
    assert observation["slot_mask"].sum(axis=1).tolist() == [19, 19, 19, 29, 29]


def test_a_seed_decides_everything_and_another_seed_something_else():
    env = make_vec(2, ["t1"])
    actions = np.full(env.action_space.shape, 0.1, np.float32)

    def roll(seed):
        rows = [env.reset(seed=seed)[0]["history"]]
        rows += [env.step(actions)[0]["history"] for _ in range(5)]
        return np.array([*rows, env.reset()[0]["history"]])

    np.testing.assert_array_equal(roll(7), roll(7))
    assert not np.array_equal(roll(7), roll(8))


def test_the_last_observation_of_an_episode_is_the_one_before_the_reset():
    env = make_vec(2, ["t1"])
    env.reset(seed=0)
    lying = np.zeros(env.action_space.shape, np.float32)
    lying[0, ::2] = 1.0
    for _ in range(200):
        observation, _, terminations, _, info = env.step(lying)
        if terminations.any():
            break
    else:
        raise AssertionError("nobody fell")
    fallen = int(terminations.nonzero()[0][0])
    np.testing.assert_array_equal(info["_final_obs"], terminations)
    last = info["final_obs"][fallen]
    assert last in env.single_observation_space
    gravity = slice(3, 6)
    assert last["history"][gravity][2] > observation["history"][fallen][gravity][2], "it lay deeper than it stands now"


def test_the_last_observation_of_a_single_robot_is_returned_at_the_end():
    env = gymnasium.make(ENV_ID, robots=["t1"]).unwrapped
    env.reset(seed=0)
    action = np.zeros(32, np.float32)
    action[::2] = 1.0
    for _ in range(200):
        before, _, terminated, _, _ = env.step(action)
        if terminated:
            break
    else:
        raise AssertionError("it did not fall")
    after, _ = env.reset()
    assert before["history"][5] > after["history"][5]


def test_actions_at_the_bound_are_actions_of_the_task():
    env = make_vec(1, ["h1"])
    env.reset(seed=0)
    observation, *_ = env.step(np.ones((1, 32), np.float32))
    scale = env.unwrapped._sim.task.observations.scales.last_action
    np.testing.assert_allclose(observation["history"][0, 70:102], ACTION_UNIT * scale * observation["slot_mask"][0])


def test_stepping_before_the_first_reset_is_refused():
    with pytest.raises(ResetNeeded):
        make_vec(1, ["h1"]).step(np.zeros((1, 32), np.float32))


def test_unknown_robots_and_several_in_one_are_refused():
    with pytest.raises(RobotError, match="h1"):
        envs.gym.HumanoidVectorEnv(1, robots=["h2"])
    with pytest.raises(ConfigError, match="make_vec"):
        envs.gym.HumanoidGymEnv(robots=["h1", "g1"])


def test_the_last_picture_of_an_episode_shows_where_it_ended(monkeypatch):
    shown = []

    class Recorder:
        def __init__(self, *_):
            pass

        def show(self, poses):
            shown.append(poses[0][2])

        def frame(self):
            return np.zeros((1, 1, 3), np.uint8)

    monkeypatch.setattr(envs.gym, "OffscreenRenderer", Recorder)
    monkeypatch.setattr(envs.gym, "Stage", lambda specs: None)
    env = envs.gym.HumanoidGymEnv(robots=["t1"], render_mode="rgb_array")
    env.reset(seed=0)
    action = np.zeros(32, np.float32)
    action[::2] = 1.0
    while not env.step(action)[2]:
        pass
    env.render()
    env.reset()
    env.render()
    assert shown[0] < shown[1] - 0.02, "it lay lower than it stands now"


def test_steps_in_inference_mode_do_not_keep_it_from_being_reset():
    env = make_vec(2, ["t1"])
    with torch.inference_mode():
        env.reset(seed=0)
        env.step(np.zeros((2, 32), np.float32))
    observation, _ = env.reset()
    assert observation in env.observation_space


def test_the_default_task_is_the_same_whenever_it_is_built_anew():
    env = make_vec(1, ["t1"])
    env.reset(seed=0)
    task = env.unwrapped._sim.env
    assert task.penalty_scale == 1.0
    assert task.commands.sampler.weights.min() == 1.0, "all commands are open"


def test_too_few_environments_are_refused_before_anything_is_built():
    with pytest.raises(ConfigError, match="one for each of 2 robots"):
        make_vec(1, ["h1", "g1"])
