"""The policy in ``checkpoints/``: whole, small, the same in every file, and able to walk."""

from __future__ import annotations

import dataclasses
import hashlib
import json

import numpy as np
import pytest
import torch

from eagle_rl.cli.evaluate import METHODS
from eagle_rl.cli.policy import load_policy
from eagle_rl.cli.sim2sim import simulate
from eagle_rl.config.commands import parse_commands
from eagle_rl.evaluation.protocol import evaluation_task
from eagle_rl.export.onnx import TOLERANCE, compare
from eagle_rl.export.runtime import OnnxPolicy
from eagle_rl.paths import data_root
from envs.humanoid_env import HumanoidEnv
from envs.robots.load import load_robot

FILE = data_root() / "checkpoints" / "generalist.safetensors"
ONNX, MANIFEST = FILE.with_suffix(".onnx"), FILE.with_suffix(".json")
MAX_BYTES = 3 << 20

pytestmark = pytest.mark.skipif(not FILE.exists(), reason="no policy is published in this tree")


@pytest.fixture(scope="module")
def policy():
    return load_policy(FILE)


def test_the_manifest_describes_the_file_beside_it(policy):
    told = json.loads(MANIFEST.read_text())
    assert told["published"]["file"] == FILE.name
    assert told["published"]["sha256"] == hashlib.sha256(FILE.read_bytes()).hexdigest()
    assert told["policy"]["sha256"] == policy.sha256
    assert told["policy"]["env_steps"] == policy.env_steps > 0
    assert policy.cfg.name in METHODS


def test_every_file_is_small():
    assert {p.name: p.stat().st_size for p in (FILE, ONNX, MANIFEST) if p.stat().st_size >= MAX_BYTES} == {}


def test_onnx_computes_the_same_for_the_same_robots(policy):
    contract = OnnxPolicy(ONNX, policy.cfg.robots[0]).contract
    assert contract.checkpoint == policy.sha256
    assert set(contract.robots) == set(policy.cfg.robots)
    assert compare(policy.actor.as_onnx(), ONNX.read_bytes()) <= TOLERANCE


def test_its_robots_walk_forward_when_told_to(policy):
    names = policy.cfg.robots
    protocol = dataclasses.replace(policy.cfg.evaluation, num_steps=200)
    env = HumanoidEnv(
        evaluation_task(policy.cfg.task, protocol), [load_robot(name) for name in names], len(names), seed=1
    )
    env.pin_commands(torch.tensor([0.6, 0.0, 0.0, 0.0, 0.0]).expand(len(names), -1))
    speeds = []
    with torch.inference_mode():
        for _ in range(200):
            *_, dones, _ = env.step(policy.actor(env.get_observations()))
            assert not dones.any(), f"fell: {[n for n, d in zip(names, dones, strict=True) if d]}"
            speeds.append(env.measured_commands()[:, 0])
    mean = torch.stack(speeds[100:]).mean(0)
    assert dict(zip(names, mean.tolist(), strict=True)) == pytest.approx(dict.fromkeys(names, 0.6), abs=0.3)


@pytest.mark.parametrize("robot", ["h1", "adam"])
def test_the_exported_file_keeps_a_robot_up_in_plain_mujoco(robot):
    script = parse_commands("- {t: 0, vx: 0.4}\n- {t: 2, vx: 0.4}")
    outcome = simulate(OnnxPolicy(ONNX, robot), load_robot(robot), script, substeps=4)
    assert not outcome.fell, f"after {outcome.survived_s:.1f} s"
    assert np.isfinite(outcome.errors).all()
