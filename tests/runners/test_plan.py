"""Plans as data."""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.config.schema import ExperimentCfg, PlanCfg
from eagle_rl.runners.plan import plan_stages, warm_task
from eagle_rl.runners.records import Record, active_stages, converged_round

EAGLE = PlanCfg(method="eagle", generalist_env_steps=100, specialist_env_steps=10, distill_env_steps=20, max_rounds=3)


def plan(**changes) -> list:
    return plan_stages(ExperimentCfg(name="x", plan=dataclasses.replace(EAGLE, **changes)))


def test_ppo_is_the_generalist_alone():
    assert [stage.name for stage in plan(method="ppo")] == ["generalist"]


def test_every_round_starts_from_the_generalist_before_it():
    stages = {stage.name: stage for stage in plan()}
    assert stages["round1/specialist_g1"].inputs == ("generalist",)
    assert stages["round1/distill"].init == "generalist"
    assert stages["round2/specialist_g1"].inputs == ("round1/distill",)
    assert stages["round2/distill"].init == "round1/distill"


def test_distillation_has_one_teacher_per_robot_in_order():
    cfg = ExperimentCfg(name="x", plan=EAGLE)
    distill = next(stage for stage in plan_stages(cfg) if stage.kind == "distill")
    assert distill.robots == cfg.robots
    assert distill.teachers == tuple(f"round1/specialist_{robot}" for robot in cfg.robots)


def test_a_search_follows_each_specialists_training_and_ends_with_the_teacher():
    stages = {stage.name: stage for stage in plan(search_env_steps=2 * 192 * 240 + 1)}
    search = stages["round2/search_g1"]
    assert search.inputs == ("round2/specialist_g1",)
    assert search.iterations == 2, "generations of 192 pairs and 240 steps"
    assert stages["round2/distill"].teachers[1] == search.name
    assert search.specialised


def test_a_correction_follows_the_search_and_ends_with_the_teacher():
    stages = {stage.name: stage for stage in plan(search_env_steps=1, correction_env_steps=3 * 768 * 220 + 1)}
    correct = stages["round2/correct_g1"]
    assert correct.inputs == ("round2/search_g1",)
    assert correct.iterations == 2, "probes of three rollouts of 768 robots and 220 steps"
    assert stages["round2/distill"].teachers[1] == correct.name
    assert correct.specialised
    assert stages["round2/search_g1"].position < correct.position < stages["round2/distill"].position


def test_specialists_stand_half_a_round_before_the_generalist_they_teach_searched_ones_a_quarter():
    stages = {stage.name: stage.position for stage in plan(search_env_steps=1)}
    assert stages["generalist"] == 0
    names = ("specialist_g1", "search_g1", "distill")
    assert [stages[f"round2/{name}"] for name in names] == [1.5, 1.75, 2]
    residual = {stage.name: stage.position for stage in plan(method="compass")}["compass/residual_g1"]
    assert residual == 0.5


def test_a_search_alone_starts_from_the_generalist():
    stages = {stage.name: stage for stage in plan(specialist_env_steps=0, search_env_steps=10)}
    assert not [name for name in stages if "specialist" in name]
    assert stages["round2/search_g1"].inputs == ("round1/distill",)


def test_an_average_ends_a_round_and_the_next_one_starts_from_it():
    stages = {stage.name: stage for stage in plan(start_share=0.5)}
    average = stages["round1/average"]
    assert average.inputs == ("round1/distill", "generalist")
    assert (average.env_steps, average.iterations, average.specialised) == (0, 0, False)
    assert stages["round2/specialist_g1"].inputs == ("round1/average",)
    assert stages["round2/average"].inputs == ("round2/distill", "round1/average")
    records = {name: Record() for name in stages}
    scores = {"generalist": 0.5, "round1/distill": 0.3, "round1/average": 0.499}
    records |= {name: Record(score=score) for name, score in scores.items()}
    assert converged_round(list(stages.values()), records, 0.01) == 1, "a round is worth what it ends with"


def test_teachers_are_named_for_the_first_round_by_file_or_by_who_they_are():
    cfg = ExperimentCfg(name="x", robots=("h1", "g1", "t1"))
    teachers = ("generalist", "a/g1.safetensors", "specialist")
    cfg = dataclasses.replace(cfg, plan=dataclasses.replace(EAGLE, teachers=teachers, max_rounds=2))
    stages = {stage.name: stage for stage in plan_stages(cfg)}
    assert stages["round1/distill"].teachers == ("generalist", "round1/teacher_g1", "round1/specialist_t1")
    given = stages["round1/teacher_g1"]
    assert (given.source, given.robots, given.inputs, given.iterations) == ("a/g1.safetensors", ("g1",), (), 0)
    assert given.specialised
    assert stages["round2/distill"].teachers == tuple(f"round2/specialist_{robot}" for robot in cfg.robots)


def test_inputs_come_before_the_stages_that_need_them():
    seen: set[str] = set()
    for stage in plan():
        assert seen.issuperset(stage.inputs)
        seen.add(stage.name)


@given(steps=st.integers(1, 10**9), envs=st.integers(1, 5000))
def test_budgets_are_spent_in_whole_iterations_and_never_undershot(steps, envs):
    stage = plan_stages(ExperimentCfg(name="x", num_envs=envs, plan=PlanCfg(generalist_env_steps=steps)))[0]
    spent = stage.iterations * envs * 24
    assert steps <= spent < steps + envs * 24


@pytest.mark.parametrize("processes", [1, 2])
def test_specialists_may_have_fewer_environments_and_take_more_iterations(processes):
    cfg = ExperimentCfg(name="x", num_envs=100, plan=dataclasses.replace(EAGLE, specialist_env_steps=24 * 400))
    few = dataclasses.replace(cfg, plan=dataclasses.replace(cfg.plan, specialist_num_envs=20))
    one, other = ({s.name: s.iterations for s in plan_stages(c, processes)} for c in (cfg, few))
    assert (one.pop("round1/specialist_g1"), other.pop("round1/specialist_g1")) == (4 // processes, 20 // processes)
    pooled = [name for name in one if "specialist" not in name]
    assert [one[name] for name in pooled] == [other[name] for name in pooled], "the pool has the same environments"


def test_stages_have_seeds_of_their_own_that_follow_the_runs_seed():
    seeds = [stage.seed for stage in plan()]
    assert len(set(seeds)) == len(seeds)
    other = plan_stages(ExperimentCfg(name="x", seed=2, plan=EAGLE))
    assert not set(seeds) & {stage.seed for stage in other}


def test_a_root_takes_the_place_of_the_generalist():
    stages = plan(root="model.pt")
    assert (stages[0].name, stages[0].env_steps, stages[0].iterations) == ("root", 0, 0)
    assert stages[1].inputs == ("root",)
    assert [stage.name for stage in plan(root="model.pt", method="ppo")] == ["root", "continued"]


def test_robots_from_files_name_their_stage_by_the_stem():
    stages = plan_stages(ExperimentCfg(name="x", robots=("my/bot.yaml",), plan=EAGLE))
    assert stages[1].name == "round1/specialist_bot"


def test_compass_imitates_then_specialises_by_residuals_then_distils():
    stages = {stage.name: stage for stage in plan(method="compass", base_env_steps=5, root="model.pt")}
    base, residual, distill = (stages[f"compass/{name}"] for name in ("base", "residual_g1", "distill"))
    assert base.inputs == ("root",)
    assert residual.inputs == ("compass/base", "root"), "the base imitates and has no critic"
    assert set(distill.inputs) == {"compass/base", *(f"compass/residual_{r}" for r in ExperimentCfg(name="x").robots)}
    assert (base.init, residual.init, distill.init) == (None, None, "compass/base")
    assert (base.demonstrations, residual.demonstrations, distill.demonstrations) == (True, False, True)


def test_compass_without_a_budget_for_imitation_builds_on_the_root_itself():
    stages = {stage.name: stage for stage in plan(method="compass", base_env_steps=0, root="model.pt")}
    assert "compass/base" not in stages
    assert stages["compass/residual_g1"].inputs == ("root",)
    distill = stages["compass/distill"]
    assert (distill.init, distill.base, distill.world_model) == ("root", "root", False)


def test_a_warm_task_has_whole_penalties_finishing_ranges_and_no_aids():
    task = warm_task(ExperimentCfg(name="x").task)
    assert (task.aids.harness, task.aids.gait_shaping, task.rewards.penalty_initial) == (0.0, 0.0, 1.0)
    assert not task.commands.curriculum.enabled
    assert task.randomization.enabled, "randomization stays: specialists train in the whole task"


@pytest.mark.parametrize(
    ("scores", "converged"),
    [
        ((0.5, None, None, None), None),
        ((0.5, 0.4, None, None), None),
        ((0.5, 0.497, None, None), 1),
        ((0.5, 0.6, None, None), 1),
        ((0.5, 0.4, 0.399, None), 2),
        ((0.5, 0.4, 0.3, 0.2), None),
        ((None, 0.4, None, None), None),
    ],
)
def test_a_round_that_gains_less_than_the_tolerance_is_the_last(scores, converged):
    stages = plan()
    generalists = [stage for stage in stages if stage.kind != "specialist"]
    records = {stage.name: Record() for stage in stages}
    records |= {stage.name: Record(score=score) for stage, score in zip(generalists, scores, strict=True)}
    assert converged_round(stages, records, 0.01) == converged
    rounds = {stage.round for stage in active_stages(stages, records, 0.01)}
    assert rounds == set(range((3 if converged is None else converged) + 1))
