"""Specialists from files that teach in a run, on the toy's robots."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from eagle_rl.config.schema import CorrectionCfg, ExperimentCfg
from eagle_rl.errors import CheckpointError
from eagle_rl.runners.checkpoint import load_actor, load_correction, publish_policy, read_manifest
from eagle_rl.runners.judged import judged_results, training_steps
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.records import final_checkpoint
from eagle_rl.runners.stages import run_experiment
from eagle_rl.runners.training import train
from tests.runners.test_searching import StillToyEnv, make_still_env
from tests.runners.toy_run import make_toy_env, refuse, toy_experiment, toy_job


@pytest.fixture(scope="module")
def specialists(tmp_path_factory) -> Path:
    """A run whose specialists are corrected."""
    plan = toy_experiment(iterations=1, specialist_env_steps=0, correction_env_steps=1)
    cfg = replace(plan, correction=CorrectionCfg(num_envs=64, num_steps=12, settling_steps=2, damping=0.5))
    return run_experiment(cfg, tmp_path_factory.mktemp("specialists") / "run", make_still_env).run_dir


def taught_by(*teachers: object, **plan: object) -> ExperimentCfg:
    return toy_experiment(iterations=1, teachers=tuple(map(str, teachers)), **plan)


def corrected(run: Path, robot: str) -> Path:
    return final_checkpoint(run, f"round1/correct_{robot}")


def test_specialists_from_files_and_the_generalist_teach_as_they_act(specialists, tmp_path):
    published = publish_policy(corrected(specialists, "two"), tmp_path / "two")
    cfg = taught_by(corrected(specialists, "one"), published, "generalist", specialist_env_steps=0)
    result = run_experiment(cfg, tmp_path / "run", make_still_env)
    assert list(result.records) == ["generalist", "round1/teacher_one", "round1/teacher_two", "round1/distill"]
    obs = make_still_env(["two"], 8, cfg.task, seed=3).get_observations()
    taken, given = final_checkpoint(result.run_dir, "round1/teacher_two"), corrected(specialists, "two")
    torch.testing.assert_close(
        *(load_correction(path).act(load_actor(path)[0], obs) for path in (taken, given)), rtol=0, atol=0
    )
    assert read_manifest(taken)["parents"] == [read_manifest(given)["sha256"]], "where it came from is kept"
    assert read_manifest(result.generalist)["parents"].count(read_manifest(taken)["sha256"]) == 1


def test_a_run_is_complete_without_its_teachers_files_and_counts_none_of_their_steps(specialists, tmp_path):
    shutil.copytree(specialists, tmp_path / "elsewhere")
    cfg = taught_by(*(corrected(tmp_path / "elsewhere", name) for name in ("one", "two", "three")))
    result = run_experiment(cfg, tmp_path / "run", make_still_env)
    shutil.rmtree(tmp_path / "elsewhere")
    again = run_experiment(cfg, tmp_path / "run", make_still_env, resume=True)
    assert again.generalist == result.generalist
    steps = 2 * cfg.num_envs * cfg.algo.num_steps_per_env
    assert result.env_steps == training_steps(result.generalist) == steps, "the generalist and its distillation"
    assert "given specialist, round 1" in judged_results(result.run_dir, plan_stages(cfg))


def test_a_robot_given_by_a_path_keeps_its_hash_and_is_taught_by_a_specialist_of_its_name(specialists, tmp_path):
    cfg = taught_by(corrected(specialists, "one"), "generalist", "generalist")
    cfg = replace(cfg, robots=("my/one.yaml", "two", "three"))

    def make_env(robots: Sequence[str], *rest: Any) -> StillToyEnv:
        return make_still_env([Path(robot).stem for robot in robots], *rest)

    hashes = {"one": "aa", "two": "bb", "three": "cc"}
    result = run_experiment(cfg, tmp_path / "run", make_env, provenance=Provenance(robots=hashes))
    manifests = [read_manifest(final_checkpoint(result.run_dir, name)) for name in ("round1/teacher_one", "generalist")]
    assert [manifest["robot_hashes"] for manifest in manifests] == [{"one": "aa"}, hashes]


def test_the_second_round_trains_specialists_of_its_own(specialists, tmp_path):
    teachers = [corrected(specialists, name) for name in ("one", "two", "three")]
    names = [stage.name for stage in plan_stages(taught_by(*teachers, max_rounds=2))]
    assert [name for name in names if "_one" in name] == ["round1/teacher_one", "round2/specialist_one"]


@pytest.mark.parametrize(
    ("robot", "changes", "message"),
    [
        ("two", {}, "a policy of two, expected one of one; teachers are in the order of robots"),
        ("one", {"clock_harmonics": 3}, "sees 2 columns of clock, not 12 as this experiment shows"),
    ],
)
def test_who_cannot_teach_here_is_refused_in_words(specialists, tmp_path, robot, changes, message):
    cfg = taught_by(corrected(specialists, robot), "generalist", "generalist")
    cfg = replace(cfg, task=replace(cfg.task, observations=replace(cfg.task.observations, **changes)))
    stage = next(stage for stage in plan_stages(cfg) if stage.kind == "teacher")
    job = toy_job(replace(cfg, robots=("one",)), stage, tmp_path / "stage", make_toy_env)
    with pytest.raises(CheckpointError, match=message):
        train(job)


def test_a_given_specialist_is_no_root(specialists, tmp_path):
    cfg = taught_by(final_checkpoint(specialists, "generalist"), "generalist", "generalist")
    stage = next(stage for stage in plan_stages(cfg) if stage.kind == "teacher")
    given = train(toy_job(replace(cfg, robots=("one",)), stage, tmp_path / "stage", make_still_env))
    forked = toy_experiment(method="ppo", root=str(given))
    with pytest.raises(CheckpointError, match="a specialist that was given to its run has no critic to go on from"):
        train(toy_job(forked, plan_stages(forked)[0], tmp_path / "root", refuse))


def test_another_width_of_embedding_is_refused(specialists, tmp_path):
    cfg = taught_by(corrected(specialists, "one"), "generalist", "generalist")
    cfg = replace(cfg, algo=replace(cfg.algo, network=replace(cfg.algo.network, embedding_dim=9)))
    stage = next(stage for stage in plan_stages(cfg) if stage.kind == "teacher")
    with pytest.raises(CheckpointError, match=r"has an embedding of 8, expected algo\.network\.embedding_dim 9"):
        train(toy_job(cfg, stage, tmp_path / "stage", make_toy_env))


def test_what_the_experiment_changes_of_a_teachers_world_is_told(specialists, tmp_path, capsys):
    cfg = taught_by(corrected(specialists, "one"), "generalist", "generalist")
    cfg = replace(cfg, task=replace(cfg.task, gait=replace(cfg.task.gait, frequency=3.0)))
    stage = next(stage for stage in plan_stages(cfg) if stage.kind == "teacher")
    train(toy_job(cfg, stage, tmp_path / "stage", make_toy_env))
    told = capsys.readouterr().err
    assert "plan.teachers" in told
    assert "task.gait.frequency" in told


def test_only_the_first_of_several_processes_takes_it(specialists):
    stage = next(
        s for s in plan_stages(taught_by(corrected(specialists, "one"), "generalist", "generalist")) if s.source
    )
    job = toy_job(taught_by(), stage, Path("stage"), refuse, rank=1)
    assert train(job) == Path("stage/checkpoints/model_0.pt"), "what the leader is going to write"


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ("none.pt", "got 'none.pt', expected specialist, generalist or a file"),
        ("genralist", "Did you mean generalist?"),
    ],
)
def test_a_teacher_that_is_not_there_is_told_before_anything_is_trained(tmp_path, named, message):
    with pytest.raises(CheckpointError) as refused:
        run_experiment(taught_by(named, "generalist", "generalist"), tmp_path / "run", refuse)
    assert message in str(refused.value)
