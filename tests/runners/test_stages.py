"""The stage machine on toy robots with the real learner."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from eagle_rl.config.load import to_yaml
from eagle_rl.errors import CheckpointError, ConfigError, EagleWarning
from eagle_rl.evaluation.evaluate import EvaluationResult
from eagle_rl.runners.checkpoint import load_actor, load_checkpoint, read_manifest
from eagle_rl.runners.claims import Claim, ClaimLostError
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.records import final_checkpoint, read_record, stage_dir
from eagle_rl.runners.stages import run_experiment
from eagle_rl.runners.training import stage_cfg, train
from tests.runners.toy_run import ENVS, STEPS, JudgedToyEnv, make_toy_env, parameters, toy_experiment, toy_job


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """One round of EAGLE, run without interruption."""
    return run_experiment(toy_experiment(), tmp_path_factory.mktemp("runs") / "eagle", make_toy_env)


def test_one_round_trains_generalist_specialists_and_distillation(finished):
    assert list(finished.records) == [
        "generalist",
        "round1/specialist_one",
        "round1/specialist_two",
        "round1/specialist_three",
        "round1/distill",
    ]
    assert all(record.state == "done" for record in finished.records.values())
    assert finished.generalist.parent.parent == stage_dir(finished.run_dir, "round1/distill")


def test_only_imitation_can_do_without_ppos_loss():
    cfg = toy_experiment()
    cfg = replace(cfg, algo=replace(cfg.algo, use_ppo_loss=False))
    with_ppo = {stage.kind: stage_cfg(cfg, stage).algo.use_ppo_loss for stage in plan_stages(cfg)}
    assert with_ppo == {"generalist": True, "specialist": True, "distill": False}


def test_costs_are_counted_per_stage(finished):
    assert {record.env_steps for record in finished.records.values()} == {3 * ENVS * STEPS}
    assert all(record.wall_seconds > 0 for record in finished.records.values())
    assert finished.env_steps == 5 * 3 * ENVS * STEPS


def test_stages_name_their_inputs_by_content(finished):
    records = finished.records
    generalist = records["generalist"].sha256
    assert records["round1/specialist_two"].inputs == {"generalist": generalist}
    specialists = {name: r.sha256 for name, r in records.items() if "specialist" in name}
    assert records["round1/distill"].inputs == {"generalist": generalist, **specialists}


def test_every_stage_is_judged_on_its_own_robots(finished):
    path = stage_dir(finished.run_dir, "round1/specialist_two") / "evaluation.json"
    result = EvaluationResult.read(path)
    assert list(result.robots) == ["two"]
    assert result.checkpoint == finished.records["round1/specialist_two"].sha256
    assert result.env_steps == 2 * 3 * ENVS * STEPS, "the generalist's steps and its own"


def test_a_specialist_starts_from_the_generalists_weights(tmp_path):
    cfg = toy_experiment(iterations=1, judge_envs=0, specialist_num_envs=5)
    seen, sizes = {}, {}

    def watch(robots, num_envs, task, seed, first=0):
        seen[tuple(robots)], sizes[tuple(robots)] = task, num_envs
        return make_toy_env(robots, num_envs, task, seed)

    run_experiment(cfg, tmp_path / "run", watch)
    assert seen[("one", "two", "three")].aids.harness == 0.0, "distillation is the last pooled stage"
    assert seen[("two",)].aids.harness == 0.0
    assert (sizes[("one", "two", "three")], sizes[("two",)]) == (ENVS, 5)
    assert not seen[("two",)].commands.curriculum.enabled


def test_a_finished_run_resumes_to_itself(finished):
    again = run_experiment(toy_experiment(), finished.run_dir, make_toy_env, resume=True)
    assert again.records == finished.records


def test_a_run_is_not_overwritten_without_resume(finished):
    with pytest.raises(ConfigError, match="holds a run already"):
        run_experiment(toy_experiment(), finished.run_dir, make_toy_env)


def test_a_folder_without_a_plan_cannot_be_resumed(tmp_path):
    with pytest.raises(CheckpointError, match=r"not a run directory: it has no plan\.json"):
        run_experiment(toy_experiment(), tmp_path, make_toy_env, resume=True)
    assert not list(tmp_path.iterdir())


def test_resume_with_another_configuration_lists_what_changed(finished):
    with pytest.raises(ConfigError, match=r"plan\.distill_env_steps: 144 -> 7"):
        run_experiment(toy_experiment(distill_env_steps=7), finished.run_dir, make_toy_env, resume=True)


def cut_after(steps):
    """Environments whose process is interrupted, without time to save, after so many control steps."""

    class Cut(JudgedToyEnv):
        left = steps

        def step(self, actions):
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
            return super().step(actions)

    return lambda robots, num_envs, task, seed, first=0: Cut(num_envs, tuple(robots), seed)


def test_a_run_that_drifted_goes_on_with_its_new_values_and_all_of_it_is_marked(tmp_path):
    old = toy_experiment(iterations=2, judge_envs=0)
    new = replace(old, algo=replace(old.algo, gamma=0.9))
    with pytest.raises(KeyboardInterrupt):
        run_experiment(old, tmp_path, cut_after(STEPS))
    with pytest.raises(KeyboardInterrupt):
        run_experiment(new, tmp_path, cut_after(0), resume=True, allow_drift=True)
    assert (tmp_path / "config.yaml").read_text() == to_yaml(new), "what --resume reads"
    result = run_experiment(new, tmp_path, make_toy_env, resume=True)
    assert json.loads((tmp_path / "plan.json").read_text())["provenance"]["drifted"]
    for name in result.records:
        assert read_manifest(final_checkpoint(tmp_path, name))["drifted"], name
    with pytest.raises(ConfigError, match=r"gamma: 0\.9 -> 0\.99"):
        run_experiment(old, tmp_path, make_toy_env, resume=True)


def test_a_drift_to_a_budget_already_passed_ends_the_stage_with_what_there_is(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run_experiment(toy_experiment(iterations=3, judge_envs=0, method="ppo"), tmp_path, cut_after(2 * STEPS))
    less = toy_experiment(iterations=1, judge_envs=0, method="ppo")
    result = run_experiment(less, tmp_path, make_toy_env, resume=True, allow_drift=True)
    assert result.generalist.name == "model_2.pt"
    assert result.env_steps == 2 * ENVS * STEPS


def test_two_workers_reach_the_same_parameters_as_one(finished, tmp_path):
    both = run_experiment(toy_experiment(), tmp_path / "run", make_toy_env, jobs=2)
    one, two = parameters(finished), parameters(both)
    assert all(torch.equal(one[key], two[key]) for key in one)


def test_a_worker_whose_stage_was_taken_over_leaves_it_unrecorded_and_goes_on(tmp_path, monkeypatch):
    check, lost = Claim.check, []

    def lose_once(claim):
        if not lost:
            lost.append(read_record(tmp_path, "generalist").state)
            raise ClaimLostError
        check(claim)

    monkeypatch.setattr(Claim, "check", lose_once)
    result = run_experiment(toy_experiment(iterations=1, judge_envs=0), tmp_path, make_toy_env)
    assert lost == ["training"]
    assert result.records["round1/distill"].state == "done"


def test_a_run_whose_folder_vanishes_goes_on_to_its_end(tmp_path):
    class Vandal(JudgedToyEnv):
        steps = 0

        def step(self, actions):
            self.steps += 1
            if self.steps == 2 * STEPS + 2:  # in the third iteration, two checkpoints written
                shutil.rmtree(tmp_path / "run")
            return super().step(actions)

    with pytest.warns(EagleWarning, match="training goes on") as caught:
        result = run_experiment(
            toy_experiment(iterations=5, judge_envs=0, method="ppo"),
            tmp_path / "run",
            lambda robots, num_envs, task, seed, first=0: Vandal(num_envs, tuple(robots), seed),
        )
    assert len(caught) == 1, "once a minute"
    assert load_checkpoint(result.generalist).manifest["iteration"] == 5
    assert result.records["generalist"].state == "done"


def test_rounds_stop_when_the_score_no_longer_improves(tmp_path):
    result = run_experiment(toy_experiment(iterations=1, max_rounds=3, tolerance=10.0), tmp_path / "run", make_toy_env)
    assert result.records["round1/distill"].state == "done"
    assert result.records["round2/specialist_one"].state == "pending"
    assert "round1" in str(result.generalist)


def test_rounds_go_on_while_the_score_improves(tmp_path):
    cfg = toy_experiment(iterations=1, max_rounds=2, tolerance=-10.0)
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    assert "round2" in str(result.generalist)
    assert result.records["round2/specialist_one"].inputs.keys() == {"round1/distill"}


def test_ppo_continued_forks_from_a_root_with_fresh_counters(finished, tmp_path):
    root = finished.run_dir / finished.records["generalist"].checkpoint
    cfg = toy_experiment(iterations=2, method="ppo", root=str(root))
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    assert list(result.records) == ["root", "continued"]
    assert result.records["root"].sha256 == finished.records["generalist"].sha256
    assert result.records["root"].env_steps == 0
    assert result.env_steps == 2 * ENVS * STEPS


def test_a_root_trained_with_other_actions_is_told(finished, tmp_path, capsys):
    root = finished.run_dir / finished.records["generalist"].checkpoint
    cfg = toy_experiment(iterations=1, judge_envs=0, method="ppo", root=str(root))
    run_experiment(cfg, tmp_path / "same", make_toy_env)
    assert "warning" not in capsys.readouterr().err
    control = replace(cfg.task.control, waist_ratio=0.125)
    run_experiment(replace(cfg, task=replace(cfg.task, control=control)), tmp_path / "other", make_toy_env)
    assert "task.control.waist_ratio: 0.5 -> 0.125" in capsys.readouterr().err


def test_kickstarting_distils_with_its_own_loss(finished, tmp_path):
    root = finished.run_dir / finished.records["generalist"].checkpoint
    cfg = toy_experiment(iterations=1, judge_envs=0, method="kickstarting", root=str(root))
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    metrics = (stage_dir(result.run_dir, "round1/distill") / "metrics.jsonl").read_text()
    assert "Distill/kickstart_kl" in metrics
    assert "Distill/L_a" not in metrics


def test_distillation_learns_from_the_specialists_of_this_round(finished):
    metrics = (stage_dir(finished.run_dir, "round1/distill") / "metrics.jsonl").read_text()
    assert all(f"Distill/L_{loss}/{robot}" in metrics for loss in "ae" for robot in ("one", "two", "three"))


def test_a_damaged_input_is_refused_by_name(tmp_path):
    cfg = toy_experiment(iterations=1, judge_envs=0)
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    damaged = result.run_dir / result.records["generalist"].checkpoint
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    (stage_dir(result.run_dir, "round1/distill") / "stage.json").unlink()
    with pytest.raises(CheckpointError, match="generalist"):
        run_experiment(cfg, result.run_dir, make_toy_env, resume=True)


def test_a_missing_root_is_named(tmp_path):
    with pytest.raises(CheckpointError, match="nowhere"):
        run_experiment(toy_experiment(method="ppo", root="nowhere.pt"), tmp_path / "run", make_toy_env)


def test_a_run_can_be_the_root(finished, tmp_path):
    cfg = toy_experiment(iterations=1, judge_envs=0, method="ppo", root=str(finished.run_dir))
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    assert result.records["root"].sha256 == finished.records["round1/distill"].sha256


def test_who_reads_the_root_while_another_process_copies_it_reads_all_of_it(finished, tmp_path):
    root = finished.run_dir / finished.records["generalist"].checkpoint
    cfg = toy_experiment(method="ppo", root=str(root))
    checkpoints = tmp_path / "checkpoints"
    checkpoints.mkdir()
    theirs = checkpoints / root.name
    shutil.copyfile(root, theirs)
    job = toy_job(cfg, plan_stages(cfg)[0], tmp_path)
    with theirs.open("rb") as reader:
        inode = theirs.stat().st_ino
        with pytest.warns(EagleWarning, match="no such manifest"):  # which comes last
            assert train(job) == theirs
        assert theirs.stat().st_ino != inode, "copied into the file that another process has open"
        assert reader.read() == root.read_bytes()


def test_the_run_is_complete_without_its_root(finished, tmp_path):
    root = finished.run_dir / finished.records["generalist"].checkpoint
    result = run_experiment(
        toy_experiment(iterations=1, judge_envs=0, method="ppo", root=str(root)), tmp_path / "run", make_toy_env
    )
    copied = result.run_dir / result.records["root"].checkpoint
    assert Path(result.run_dir) in copied.parents
    assert load_checkpoint(copied).manifest["sha256"] == result.records["root"].sha256
    assert read_record(result.run_dir, "continued").inputs == {"root": result.records["root"].sha256}


def test_what_goes_on_from_a_root_may_end_between_both(finished, tmp_path):
    root = finished.run_dir / finished.records["generalist"].checkpoint
    cfg = toy_experiment(iterations=1, judge_envs=0, method="ppo", root=str(root), start_share=0.25)
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    start, continued, average = (
        load_actor(final_checkpoint(result.run_dir, name))[0].state_dict() for name in ("root", "continued", "averaged")
    )
    assert result.generalist == final_checkpoint(result.run_dir, "averaged")
    assert "processes" not in load_checkpoint(result.generalist).state, "no environments go on from an average"
    for name, x in average.items():
        torch.testing.assert_close(x, 0.25 * start[name] + 0.75 * continued[name], msg=name)
    assert any(not torch.equal(start[name], continued[name]) for name in start)


def test_a_round_may_end_between_where_it_started_and_what_was_distilled(tmp_path):
    cfg = toy_experiment(iterations=1, start_share=0.25)
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    start, distilled, average = (
        load_actor(final_checkpoint(result.run_dir, name))[0].state_dict()
        for name in ("generalist", "round1/distill", "round1/average")
    )
    assert result.generalist == final_checkpoint(result.run_dir, "round1/average")
    assert result.records["round1/average"].env_steps == 0
    assert result.records["round1/average"].score is not None, "it is judged like the others"
    for name, x in average.items():
        torch.testing.assert_close(x, 0.25 * start[name] + 0.75 * distilled[name], msg=name)
    assert any(not torch.equal(start[name], distilled[name]) for name in start)
    again = run_experiment(cfg, result.run_dir, make_toy_env, resume=True)
    assert again.records == result.records
