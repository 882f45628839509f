"""The whole loop on real robots through the command line, once: every stage, table, status, resume, refusal."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from eagle_rl.cli.main import run_verb
from eagle_rl.runners.checkpoint import load_checkpoint
from eagle_rl.runners.locate import find_checkpoint
from envs.humanoid_env import HumanoidEnv
from tests.learner.test_runner import compare


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the run of this file lives."""
    return tmp_path_factory.mktemp("smoke")


@pytest.fixture(scope="module")
def run_dir(folder):
    """A finished run."""
    words = ["smoke", "robots=[t1, n1]", "num_envs=4", "--out", str(folder)]
    assert run_verb("train", words) == 0
    (run_dir,) = (folder / "smoke").iterdir()
    return run_dir


def files(run_dir: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()}


def test_every_stage_leaves_a_checkpoint_numbers_and_a_judgement(run_dir):
    stages = ("generalist", "round1/specialist_t1", "round1/specialist_n1", "round1/distill")
    for stage in stages:
        stage_dir = run_dir / "stages" / stage
        assert find_checkpoint(stage_dir).exists()
        assert (stage_dir / "evaluation.json").exists()
        assert (stage_dir / "metrics.jsonl").read_text().strip()
        assert list(stage_dir.glob("events.out.tfevents.*"))
    assert "distill" in str(find_checkpoint(run_dir)), "a run's checkpoint is its most advanced generalist"


def test_a_finished_run_resumed_prints_its_table_and_changes_nothing(run_dir, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    before = files(run_dir)
    assert run_verb("train", ["--resume", str(run_dir)]) == 0
    assert files(run_dir) == before
    out = capsys.readouterr().out
    for row in ("stand still", "best constant", "generalist", "specialist, round 1", "generalist, round 1"):
        assert sum(f" {row} " in line for line in out.splitlines()) == 2, f"one row of {row!r} per robot"


def test_a_run_resumed_with_another_value_is_refused_and_left_alone(run_dir, capsys):
    before = files(run_dir)
    assert run_verb("train", ["--resume", str(run_dir), "algo.gamma=0.9"]) == 2
    assert "config.algo.gamma: 0.99 -> 0.9" in capsys.readouterr().err
    assert files(run_dir) == before


def test_a_run_interrupted_and_resumed_ends_with_the_same_bits(tmp_path, monkeypatch):
    words = ["smoke", "robots=[t1]", "num_envs=2", "plan.method=ppo", "plan.judge_envs_per_robot=0", "--out"]
    assert run_verb("train", [*words, str(tmp_path / "whole")]) == 0
    steps, step = [], HumanoidEnv.step

    def interrupted(env, actions):
        steps.append(1)
        if len(steps) == 30:  # in the fourth of ten iterations and in mid-episode
            signal.raise_signal(signal.SIGTERM)
        return step(env, actions)

    monkeypatch.setattr(HumanoidEnv, "step", interrupted)
    assert run_verb("train", [*words, str(tmp_path / "cut")]) == 130
    (cut,) = (tmp_path / "cut" / "smoke").iterdir()
    assert find_checkpoint(cut).name == "model_4.pt"
    assert run_verb("train", ["--resume", str(cut)]) == 0
    (whole,) = (tmp_path / "whole" / "smoke").iterdir()
    ends = [load_checkpoint(find_checkpoint(run)).state for run in (whole, cut)]
    for end in ends:
        end["runner"].pop("wall_time")
    compare(*ends, "state")


def test_status_shows_every_stage_done(run_dir, capsys):
    assert run_verb("status", [str(run_dir)]) == 0
    assert capsys.readouterr().out.count(" done ") == 4
