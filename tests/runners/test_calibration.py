"""Command gains of a specialist, on robots that make a known share of what they are asked for."""

from __future__ import annotations

import json
from collections.abc import Sequence

import pytest
import torch
from tensordict import TensorDict

from eagle_rl.config.schema import EvaluationCfg, TaskCfg
from eagle_rl.models import EagleActor
from eagle_rl.runners.calibration import calibrate
from eagle_rl.runners.records import stage_dir
from eagle_rl.runners.stages import run_experiment
from tests.evaluation.fake import ScriptedEnv
from tests.runners.toy_run import make_toy_env, parameters, toy_experiment

DIMS = {"history": 6, "command": 5, "clock": 2, "estimate": 3}
SHIFT = 10.0
"""Added before the activation and taken off behind it: ELU is the identity above zero."""


class FollowingEnv(ScriptedEnv):
    """What it measures is what the policy does."""

    def get_observations(self) -> TensorDict:
        n = self.num_envs
        rest = {"history": torch.zeros(n, 6), "clock": torch.zeros(n, 2), "slot_mask": torch.ones(n, 32)}
        return TensorDict({**rest, "command": self.command.clone()}, batch_size=[n])


def make_following_env(robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first: int = 0) -> FollowingEnv:
    return FollowingEnv(num_envs, task)


def follower(shares: Sequence[float]) -> EagleActor:
    """An actor whose first five actions are these shares of the command."""
    networks = {
        "history_length": 2,
        "hidden_dims": [5],
        "encoder_dims": [4],
        "estimator_dims": [4],
        "embedding_dim": 4,
        "activation": "elu",
        "init_std": 0.1,
        "std_range": [0.05, 0.4],
    }
    actor = EagleActor.from_architecture({"observations": DIMS, "num_actions": 32, "networks": networks})
    first, _, last = actor.mlp
    with torch.no_grad():
        first.weight.zero_()
        first.weight[:, -7:-2] = torch.eye(5)
        first.bias.fill_(SHIFT)
        last.weight.zero_()
        last.weight[:5] = torch.diag(torch.tensor(shares))
        last.bias.zero_()
        last.bias[:5] = -SHIFT * torch.tensor(shares)
    return actor


@pytest.mark.parametrize(
    ("shares", "gains"),
    [
        ((1.0, 1.0, 1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
        ((1.0, 0.5, 1.0, 1.0, 1.0), (1.0, 1.2, 1.0)),
        ((0.92, 0.8, 0.9, 0.5, 0.5), (1.1, 1.2, 1.1)),
        ((1.2, 1.0, 1.2, 1.0, 1.0), (1.0, 1.0, 1.0)),
        ((0.952, 1.0, 1.0, 0.5, 0.5), (1.0, 1.0, 1.0)),  # 1.047 is hardly nearer than 0.952
    ],
)
def test_a_velocity_that_falls_short_is_asked_for_more_and_no_other(shares, gains):
    ev = EvaluationCfg(num_envs_per_robot=64, num_steps=4)
    found = calibrate(follower(shares), make_following_env, ["h1"], TaskCfg(), ev, "cpu")
    assert (found["v_x"], found["v_y"], found["omega"]) == gains, f"shares {shares}: {found}"
    assert found["score_after"] <= found["score_before"]


def test_a_gain_that_spoils_another_command_is_not_taken():
    """A robot that turns a little as it walks turns a tenth more at a tenth more speed, though its score is better."""
    actor = follower((0.8, 1.0, 1.0, 1.0, 1.0))
    ev = EvaluationCfg(num_envs_per_robot=64, num_steps=4)
    assert calibrate(actor, make_following_env, ["h1"], TaskCfg(), ev, "cpu")["v_x"] == 1.2
    turning = follower((0.8, 1.0, 1.0, 1.0, 1.0))
    with torch.no_grad():
        turning.mlp[-1].weight[2, 0] = 0.05
        turning.mlp[-1].bias[2] -= 0.05 * SHIFT
    assert calibrate(turning, make_following_env, ["h1"], TaskCfg(), ev, "cpu")["v_x"] == 1.0


def test_gains_are_in_the_weights():
    actor = follower((1.0, 0.5, 1.0, 1.0, 1.0))
    calibrate(actor, make_following_env, ["h1"], TaskCfg(), EvaluationCfg(num_envs_per_robot=64, num_steps=4), "cpu")
    obs = FollowingEnv(1, TaskCfg())
    obs.pin_commands(torch.tensor([[1.0, 0.2, 0.5, -0.1, 0.3]]))
    expected = torch.tensor([[1.0, 0.5 * 1.2 * 0.2, 0.5, -0.1, 0.3]])
    torch.testing.assert_close(actor(obs.get_observations())[:, :5], expected, atol=1e-5, rtol=0)


def test_specialists_of_a_run_are_calibrated_once_and_say_how(tmp_path):
    cfg = toy_experiment(iterations=1, calibration_envs=4)
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    for name in ("one", "two", "three"):
        found = json.loads((stage_dir(result.run_dir, f"round1/specialist_{name}") / "calibration.json").read_text())
        assert found["score_after"] <= found["score_before"]
    for name in ("generalist", "round1/distill"):
        assert not (stage_dir(result.run_dir, name) / "calibration.json").exists(), f"{name} has many robots"
    again = run_experiment(cfg, result.run_dir, make_toy_env, resume=True)
    assert all(torch.equal(x, parameters(result)[key]) for key, x in parameters(again).items())
