"""Finding checkpoints and scores in a run's folder."""

from __future__ import annotations

import pytest

from eagle_rl.errors import CheckpointError
from eagle_rl.runners.judged import judged_results, training_steps
from eagle_rl.runners.locate import find_checkpoint
from eagle_rl.runners.records import read_plan, stage_dir
from eagle_rl.runners.stages import run_experiment
from tests.runners.toy_run import ENVS, STEPS, make_toy_env, toy_experiment


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    cfg = toy_experiment(iterations=2, judge_envs=2)
    return run_experiment(cfg, tmp_path_factory.mktemp("run"), make_toy_env)


def test_a_run_means_its_most_advanced_generalist(run):
    assert find_checkpoint(run.run_dir) == run.generalist


def test_a_stage_means_its_latest_checkpoint(run):
    folder = stage_dir(run.run_dir, "round1/specialist_two")
    assert find_checkpoint(folder) == find_checkpoint(folder / "checkpoints") == folder / "checkpoints" / "model_2.pt"


def test_files_mean_themselves(run, tmp_path):
    assert find_checkpoint(run.generalist.with_suffix(".json")) == run.generalist
    published = tmp_path / "policy.safetensors"
    published.write_text("")
    assert find_checkpoint(published) == find_checkpoint(published.with_suffix(".json")) == published


def test_a_folder_without_checkpoints_is_refused_in_words(tmp_path):
    with pytest.raises(CheckpointError, match=r"model_<iteration>\.pt"):
        find_checkpoint(tmp_path)


def test_scores_of_a_run_are_rows_with_all_specialists_in_one(run):
    rows = judged_results(run.run_dir, read_plan(run.run_dir))
    assert list(rows) == ["generalist", "specialist, round 1", "generalist, round 1"]
    assert [list(result.robots) for result in rows["specialist, round 1"]] == [["one"], ["two"], ["three"]]


def test_a_policy_costs_its_stage_and_all_it_was_made_from(run):
    stage = 2 * ENVS * STEPS
    specialist = find_checkpoint(stage_dir(run.run_dir, "round1/specialist_two"))
    assert training_steps(run.run_dir / run.records["generalist"].checkpoint) == stage
    assert training_steps(specialist) == 2 * stage
    assert training_steps(run.generalist) == 5 * stage, "generalist, three specialists, distillation"


def test_a_checkpoint_outside_of_a_run_has_no_known_cost(tmp_path):
    assert training_steps(tmp_path / "model_1.pt") is None
