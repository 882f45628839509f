"""``eagle evaluate`` on a run of the real simulation, and on stored results."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

from eagle_rl.cli import evaluate
from eagle_rl.cli.environment import make_env_factory
from eagle_rl.cli.evaluate import main
from eagle_rl.cli.export import main as export
from eagle_rl.cli.policy import load_policy
from eagle_rl.config.load import load_experiment
from eagle_rl.config.schema import EvaluationCfg
from eagle_rl.errors import ConfigError
from eagle_rl.evaluation.evaluate import EvaluationResult
from eagle_rl.models.correction import CorrectedPolicy
from eagle_rl.paths import data_root
from eagle_rl.runners.provenance import Provenance, slot_table_hash
from eagle_rl.runners.records import final_checkpoint
from eagle_rl.runners.stages import run_experiment
from envs.robots.slots import SLOT_NAMES
from tests.evaluation.test_falls import FALL
from tests.evaluation.test_report import result
from tests.policy import untrained_checkpoint
from tests.runners.toy_run import refuse

QUICK = ["--envs", "2", "--steps", "10"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The smoke experiment's generalist on one robot."""
    overrides = ["robots=[h1]", "plan.method=ppo", "plan.judge_envs_per_robot=0", "seed=7", "run.num_threads=1"]
    cfg = load_experiment("smoke", overrides)
    provenance = Provenance(slot_table_hash=slot_table_hash(SLOT_NAMES))
    return run_experiment(cfg, tmp_path_factory.mktemp("run"), make_env_factory(cfg.run), provenance=provenance)


@pytest.fixture(scope="module")
def corrected(tmp_path_factory):
    """A specialist of the smoke experiment with a correction of its own."""
    overrides = ["robots=[h1]", "plan.specialist_env_steps=0", "plan.correction_env_steps=1", "correction.num_envs=4"]
    overrides += ["correction.num_steps=30", "correction.settling_steps=5", "plan.judge_envs_per_robot=0"]
    cfg = load_experiment("smoke", overrides)
    provenance = Provenance(slot_table_hash=slot_table_hash(SLOT_NAMES))
    result = run_experiment(cfg, tmp_path_factory.mktemp("run"), make_env_factory(cfg.run), provenance=provenance)
    return final_checkpoint(result.run_dir, "round1/correct_h1")


def test_a_corrected_specialist_is_judged_with_its_correction(corrected):
    policy = load_policy(corrected)
    assert isinstance(policy.act, CorrectedPolicy)
    env = make_env_factory(policy.cfg.run)(["h1"], 2, policy.cfg.task, 1)
    obs = env.get_observations()
    weights = torch.full_like(policy.act.correction.weights, 0.1)
    policy.act.correction = dataclasses.replace(policy.act.correction, weights=weights)
    differs = (policy.act(obs) - policy.actor(obs)).abs()
    assert (differs[:, obs["slot_mask"][0] > 0] > 0).any()
    assert not differs[:, obs["slot_mask"][0] == 0].any(), "joints H1 does not have"
    assert main([f"corrected={corrected}", *QUICK]) == 0


def test_a_corrected_specialist_is_not_exported_without_its_correction(corrected):
    with pytest.raises(ConfigError, match="export the generalist that was distilled from it"):
        export([str(corrected)])


def test_a_corrected_specialist_is_published_with_its_correction_and_without_onnx(corrected, tmp_path, capsys):
    assert export([str(corrected), "--publish", str(tmp_path / "h1")]) == 0
    assert "no ONNX" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"h1.safetensors", "h1.json"}
    policy, original = load_policy(tmp_path / "h1.safetensors"), load_policy(corrected)
    assert isinstance(policy.act, CorrectedPolicy)
    for name, value in original.act.correction.state_dict().items():
        assert torch.equal(policy.act.correction.state_dict()[name], value), name
    obs = make_env_factory(policy.cfg.run)(["h1"], 2, policy.cfg.task, 1).get_observations()
    assert torch.equal(policy.act(obs), original.act(obs))


def test_a_run_becomes_a_table_with_hash_protocol_and_seed(run, tmp_path, capsys):
    assert main([f"PPO={run.run_dir}", *QUICK, "--out", str(tmp_path)]) == 0
    assert {f"table.{suffix}" for suffix in ("md", "csv", "tex", "json")} <= {path.name for path in tmp_path.iterdir()}
    result = EvaluationResult.read(next(tmp_path.glob("ppo_seed7_*.json")))
    assert result.checkpoint == run.records["generalist"].sha256
    assert (result.protocol.num_envs_per_robot, result.protocol.num_steps, result.seed) == (2, 10, 7)
    assert "| h1 | PPO |" in capsys.readouterr().out


def test_a_policy_trained_on_one_core_is_judged_on_all_cores_of_this_machine(run):
    assert load_policy(run.run_dir).cfg.run.num_threads == 0, "the run's number of threads is of where it was trained"


def test_how_robots_fell_is_printed_and_written_and_no_older_story_is_left(tmp_path, capsys):
    calm = result((0.1,) * 5)
    fallen = dataclasses.replace(calm.robots["h1"], falls=(FALL,))
    for name, metrics, told in (("fallen", fallen, True), ("calm", calm.robots["h1"], False)):
        stored = tmp_path / f"{name}.json"
        stored.write_text(dataclasses.replace(calm, robots={"h1": metrics}).to_json())
        assert main([f"EAGLE={stored}", "--out", str(tmp_path / "out")]) == 0
        assert ("| h1 | EAGLE | 1 of 16 |" in capsys.readouterr().out) == told, name
        assert (tmp_path / "out" / "falls.md").exists() == told, name


def test_stored_results_are_tabled_without_simulating_again(run, tmp_path, capsys):
    main([f"PPO={run.run_dir}", *QUICK, "--out", str(tmp_path)])
    stored = next(tmp_path.glob("ppo_*.json"))
    first = capsys.readouterr().out
    assert main([f"PPO={stored}"]) == 0
    assert capsys.readouterr().out == first


def test_a_policy_of_one_robot_is_the_papers_single_robot_ppo_unless_told_otherwise(run, tmp_path, capsys):
    main([str(run.generalist), *QUICK, "--out", str(tmp_path)])
    assert json.loads((tmp_path / "table.json").read_text())["checkpoints"].keys() == {"single-robot PPO"}
    assert "[0.067]" in capsys.readouterr().out, "the number of the paper's H1 table"


def test_a_policy_can_be_judged_on_robots_it_has_never_seen(run, capsys):
    assert main([f"PPO={run.run_dir}", *QUICK, "--robots", "g1"]) == 0
    out = capsys.readouterr().out
    assert "| g1 | PPO (unseen) |" in out
    assert "| h1 |" not in out


def test_protocols_are_compared_before_anything_is_judged(tmp_path, monkeypatch):
    stored = tmp_path / "old.json"
    stored.write_text(result((0.1,) * 5).to_json())
    monkeypatch.setattr(evaluate, "_judge", refuse)
    with pytest.raises(ConfigError, match="one protocol"):
        main([f"NEW={untrained_checkpoint(tmp_path, 't1')}", f"OLD={stored}", "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_what_is_going_to_be_judged_is_announced_with_what_is_quicker(run, tmp_path, capsys):
    assert main([f"PPO={run.run_dir}", *QUICK]) == 0
    assert "PPO: judging 1 robot x 2 environments x 10 steps\n" in capsys.readouterr().err
    full = evaluate.announcement("PPO", EvaluationCfg(), ("h1", "g1"))
    assert full == "PPO: judging 2 robots x 256 environments x 1000 steps (--envs 32 is quicker)"


def test_the_published_size_is_judged_as_the_paper_does():
    assert load_experiment("ppo", scale="paper").evaluation.num_envs_per_robot == 2048


def test_what_has_been_judged_is_kept_whatever_comes_next(tmp_path, monkeypatch):
    def judge(method, trial, console):
        if method == "B":
            raise KeyboardInterrupt
        return result((0.1,) * 5, ev=trial.protocol)

    monkeypatch.setattr(evaluate, "_judge", judge)
    path = untrained_checkpoint(tmp_path, "t1")
    with pytest.raises(KeyboardInterrupt):
        main([f"A={path}", f"B={path}", "--out", str(tmp_path / "out")])
    (kept,) = (tmp_path / "out").iterdir()
    assert EvaluationResult.read(kept) == result((0.1,) * 5, ev=EvaluationCfg())


def test_a_robot_is_known_by_the_name_in_its_file_however_it_is_given(run, capsys):
    assert main([f"PPO={run.run_dir}", *QUICK, "--robots", str(data_root() / "cfg/robots/h1.yaml")]) == 0
    assert "(unseen)" not in capsys.readouterr().out


def test_an_unknown_subset_is_refused(run):
    with pytest.raises(ConfigError, match="walking"):
        main([str(run.run_dir), "--subset", "walkin"])
