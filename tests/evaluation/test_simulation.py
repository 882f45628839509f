"""The protocol in the real simulation."""

from __future__ import annotations

import math
import pickle

import torch

from eagle_rl.cli.environment import make_env_factory
from eagle_rl.config.schema import AidsCfg, EvaluationCfg, RunCfg, TaskCfg
from eagle_rl.evaluation.evaluate import evaluate
from tests.evaluation.fake import idle

EV = EvaluationCfg(num_envs_per_robot=3, num_steps=60)
MAKE_ENV = make_env_factory(RunCfg(num_threads=1))


def test_pinned_commands_are_in_force_in_the_next_observation_and_stay_through_resets():
    task = TaskCfg(aids=AidsCfg(harness=0.0))
    env = MAKE_ENV(["h1"], 2, task, 0)
    command = torch.tensor([[0.0, 0.0, 0.0, -0.2, 0.1], [1.0, 0.1, 0.3, 0.0, 0.0]])
    env.pin_commands(command)
    scaled = command * torch.tensor(task.observations.scales.command)
    for _ in range(80):
        torch.testing.assert_close(env.get_observations()["command"], scaled)
        _, _, dones, _ = env.step(torch.full((2, 32), 5.0))
        if dones.any():
            break
    else:
        raise AssertionError("nobody fell, so resets were not tested")
    torch.testing.assert_close(env.get_observations()["command"], scaled)
    torch.testing.assert_close(env.get_observations()["clock"][0], torch.ones(2))


def test_the_score_does_not_depend_on_the_number_of_physics_threads():
    scores = [
        evaluate(idle, make_env_factory(RunCfg(num_threads=threads)), ["h1"], TaskCfg(), EV)["h1"] for threads in (1, 2)
    ]
    assert scores[0] == scores[1]
    assert all(e is not None and math.isfinite(e) for e in scores[0].subsets["all"].charged)


def test_randomized_and_noisy_scores_do_not_depend_on_the_chunk_size():
    ev = EvaluationCfg(num_envs_per_robot=130, num_steps=12, randomization=True, noise=True)
    whole, parts = (evaluate(idle, MAKE_ENV, ["h1"], TaskCfg(), ev, chunk_envs=chunk)["h1"] for chunk in (256, 128))
    assert whole == parts


def test_a_pool_in_parts_draws_what_the_whole_draws():
    task = TaskCfg()
    whole = MAKE_ENV(["h1"], 5, task, 3).get_observations()
    parts = [MAKE_ENV(["h1"], 2, task, 3), MAKE_ENV(["h1"], 3, task, 3, 2)]
    for name, values in whole.items():
        joined = torch.cat([part.get_observations()[name] for part in parts])
        torch.testing.assert_close(joined, values, rtol=0, atol=0, msg=f"group {name}")


def test_environment_factories_can_be_sent_to_other_processes():
    assert pickle.loads(pickle.dumps(MAKE_ENV))(["h1"], 1, TaskCfg(), 0).num_envs == 1
