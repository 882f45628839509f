"""Exported policies: the same numbers as torch, and a runtime that needs nothing but the file."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import eagle_rl
from eagle_rl.cli.export import build_contract
from eagle_rl.cli.sim2sim import MAX_TILT, simulate
from eagle_rl.config.commands import parse_commands
from eagle_rl.config.schema import ControlCfg, ExperimentCfg, GaitCfg, TaskCfg
from eagle_rl.errors import CheckpointError, RobotError
from eagle_rl.evaluation.protocol import evaluation_task
from eagle_rl.export.contract import METADATA_KEY, Contract
from eagle_rl.export.onnx import TOLERANCE, compare, export_onnx
from eagle_rl.export.runtime import OnnxPolicy, Reading, projected_gravity
from envs.geometry import rotate_inverse
from envs.humanoid_env import HumanoidEnv
from envs.robots.load import load_robot
from tests.policy import untrained_actor

ROBOTS = ("h1", "n1")
CFG = ExperimentCfg(
    name="untrained",
    robots=ROBOTS,
    task=TaskCfg(control=ControlCfg(posture_reference=0.8), gait=GaitCfg(frequency=2.0, leg_scaling=0.5)),
)
SCRIPT = parse_commands("- {t: 0}\n- {t: 1, vx: 0.5, wz: 0.3}\n- {t: 2, h: -0.2, p: 0.3, vy: -0.2}")


HARMONICS = dataclasses.replace(CFG.task.observations, clock_harmonics=3)
WITH_HARMONICS = dataclasses.replace(CFG, task=dataclasses.replace(CFG.task, observations=HARMONICS))


def export_untrained(cfg, folder):
    actor = untrained_actor(cfg)
    export_onnx(actor, build_contract(cfg, "0" * 64, ROBOTS), folder / "policy.onnx")
    return actor, folder / "policy.onnx"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    return export_untrained(CFG, tmp_path_factory.mktemp("export"))


def test_onnx_and_torch_agree_for_one_and_for_many(exported):
    actor, path = exported
    assert compare(actor.as_onnx(), path.read_bytes()) <= TOLERANCE


def test_a_file_to_give_away_holds_no_path_of_the_machine_it_was_made_on(exported):
    for path in (Path(torch.__file__).parents[1], Path(eagle_rl.__file__).parents[1]):
        assert str(path).encode() not in exported[1].read_bytes(), f"{path} is in the ONNX file: see export_onnx"


def test_a_network_that_computes_something_else_is_not_written(exported, tmp_path, monkeypatch):
    monkeypatch.setattr("eagle_rl.export.onnx.compare", lambda module, data: 2e-5)
    with pytest.raises(CheckpointError, match="differ"):
        export_onnx(exported[0], build_contract(CFG, "", ROBOTS), tmp_path / "p.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("robot", "cfg"), [("h1", CFG), ("n1", CFG), ("h1", WITH_HARMONICS)])
def test_the_runtime_chooses_the_env_s_first_200_actions_from_the_contract_alone(tmp_path, robot, cfg):
    actor, path = export_untrained(cfg, tmp_path)
    policy = OnnxPolicy(path, robot)
    protocol = dataclasses.replace(cfg.evaluation, num_steps=200, noise=False)
    env = HumanoidEnv(evaluation_task(cfg.task, protocol), [load_robot(robot)], 1, seed=1, num_threads=1)
    batch = env.pool.batches[0]
    for step in range(200):
        command = SCRIPT.at(step * env.step_dt)
        env.pin_commands(torch.as_tensor(command, dtype=torch.float32)[None])
        with torch.inference_mode():
            actions = actor(env.get_observations())
        qpos, qvel = batch.qpos[0].copy(), batch.qvel[0].copy()
        reading = Reading(base_quat=qpos[3:7], base_ang_vel=qvel[3:6], joint_pos=qpos[7:], joint_vel=qvel[6:])
        targets = policy.step(reading, command)
        np.testing.assert_allclose(policy.action, actions[0], atol=2e-5, err_msg=f"action {step}")
        *_, dones, _ = env.step(actions)
        np.testing.assert_allclose(targets, batch.ctrl[0], atol=1e-5) if not dones[0] else policy.reset()


def test_the_contract_survives_json_and_names_every_joint(exported):
    contract = OnnxPolicy(exported[1], "h1").contract
    assert Contract.from_json(contract.to_json(), "x") == contract
    for name in ROBOTS:
        assert contract.robots[name].joints == load_robot(name).joint_names
    assert len(contract.slots) == 32
    assert [term.name for term in contract.frame][:2] == ["base_ang_vel", "projected_gravity"]


@pytest.mark.parametrize("damage", ["{", "[]", '{"format": 99}', '{"format": 1}', '{"format": 1, "robots": 3}'])
def test_a_damaged_contract_is_refused_in_words(damage):
    with pytest.raises(CheckpointError, match="x"):
        Contract.from_json(damage, "x")


def test_a_changed_contract_is_refused(exported, tmp_path):
    model = onnx.load(exported[1])
    for entry in model.metadata_props:
        if entry.key == METADATA_KEY:
            entry.value = entry.value.replace('"gait_phase_offset": 0.5', '"gait_phase_offset": 0.4')
    onnx.save(model, tmp_path / "p.onnx")
    with pytest.raises(CheckpointError, match="sha256"):
        OnnxPolicy(tmp_path / "p.onnx", "h1")


def test_other_files_and_other_robots_are_refused(exported, tmp_path):
    with pytest.raises(RobotError, match="h1"):
        OnnxPolicy(exported[1], "h2")
    (tmp_path / "p.onnx").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="ONNX"):
        OnnxPolicy(tmp_path / "p.onnx", "h1")


def test_the_runtime_runs_without_torch_and_without_the_simulation(exported):
    program = (
        "import sys; sys.modules.update(torch=None, mujoco=None, rsl_rl=None)\n"
        "import numpy as np; from pathlib import Path\n"
        "from eagle_rl.export.runtime import OnnxPolicy, Reading\n"
        f"policy = OnnxPolicy(Path({str(exported[1])!r}), 'h1')\n"
        "n = len(policy.robot.joints)\n"
        "reading = Reading(base_quat=np.array([1., 0, 0, 0]), base_ang_vel=np.zeros(3), joint_pos=np.zeros(n),"
        " joint_vel=np.zeros(n))\n"
        "assert policy.step(reading, np.zeros(5)).shape == (n,)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_plain_mujoco_tells_survival_and_errors(exported):
    outcome = simulate(OnnxPolicy(exported[1], "n1"), load_robot("n1"), parse_commands("- {t: 0}"), substeps=4)
    assert 0.0 < outcome.survived_s <= 2.0
    assert outcome.fell == (outcome.survived_s < 2.0)
    assert (outcome.errors >= 0).all()
    assert outcome.errors[4] < MAX_TILT


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_gravity_agrees_with_the_task_s_own_rotation(quat):
    unit = torch.tensor(quat, dtype=torch.float64)
    unit = unit / unit.norm()
    expected = rotate_inverse(unit[None], torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64))[0]
    np.testing.assert_allclose(projected_gravity(np.array(quat)), expected, atol=1e-12)
