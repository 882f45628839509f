"""COMPASS: who acts in which stage, and what is learned from it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from eagle_rl.algorithms.eagle_ppo import LEARNING_RATE_FACTOR
from eagle_rl.algorithms.specialists import SpecialistBank
from eagle_rl.cli.policy import load_policy
from eagle_rl.errors import CheckpointError
from eagle_rl.runners.checkpoint import load_actor, load_checkpoint
from eagle_rl.runners.compass import (
    DemonstrationEnv,
    ResidualBank,
    ResidualEnv,
    ResidualPolicy,
    begin_residual,
    mean_actions,
)
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.provenance import Provenance, slot_table_hash
from eagle_rl.runners.records import stage_dir
from eagle_rl.runners.stages import run_experiment
from eagle_rl.runners.training import stage_cfg, train
from envs.robots.slots import SLOT_NAMES
from tests.learner.test_runner import compare
from tests.runners.toy_run import make_toy_env, toy_experiment, toy_job
from tests.toy import NUM_SLOTS

ROBOTS = ("one", "two", "three")
OURS = Provenance(slot_table_hash=slot_table_hash(SLOT_NAMES))
"""So that commands take the toys' checkpoints, too."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    cfg = toy_experiment(iterations=2, judge_envs=2, method="compass")
    return run_experiment(cfg, tmp_path_factory.mktemp("run"), make_toy_env, provenance=OURS)


@pytest.fixture
def actors(run):
    """Demonstrator, base, and the residuals of the three robots."""

    def load(stage: str):
        return load_actor(run.run_dir / run.records[stage].checkpoint)[0]

    return load("generalist"), load("compass/base"), [load(f"compass/residual_{robot}") for robot in ROBOTS]


def make_env(seed: int = 3):
    return make_toy_env(ROBOTS, 6, toy_experiment().task, seed)


def test_all_three_stages_end_in_one_policy(run):
    assert [name for name, record in run.records.items() if record.state == "done"] == [
        "generalist",
        "compass/base",
        *(f"compass/residual_{robot}" for robot in ROBOTS),
        "compass/distill",
    ]
    assert run.generalist.parent.parent == stage_dir(run.run_dir, "compass/distill")


def test_a_residual_is_refused_where_a_whole_policy_is_needed(run, tmp_path):
    """By itself it would be judged, taught from and trained on as if its additions were actions."""
    path = run.run_dir / run.records["compass/residual_one"].checkpoint
    starts = {"root": str(path), "method": "ppo"}, {"teachers": (str(path), "generalist", "generalist")}
    users = [
        lambda: load_policy(path),
        *(
            lambda plan=plan: run_experiment(toy_experiment(**plan), tmp_path / "on", make_toy_env, provenance=OURS)
            for plan in starts
        ),
    ]
    for use in users:
        with pytest.raises(CheckpointError, match="a residual specialist of COMPASS, which acts only on top of its"):
            use()


def test_the_base_policy_reads_a_prediction_of_the_next_frame(actors):
    demonstrator, base, _ = actors
    widths = [actor.architecture["observations"]["estimate"] for actor in (demonstrator, base)]
    assert widths[1] - widths[0] == NUM_SLOTS, "one frame of the toy"


def test_demonstrations_are_the_teachers_whatever_the_policy_does(actors):
    shown = []
    for actions in (torch.zeros(6, NUM_SLOTS), torch.ones(6, NUM_SLOTS)):
        torch.manual_seed(0)
        env = DemonstrationEnv(make_env(), SpecialistBank([actors[0]] * 3), NUM_SLOTS)
        shown.append([env.step(actions)[0] for _ in range(20)])
    assert all((a == b).all() for a, b in zip(*shown, strict=True))


def test_a_demonstration_begins_the_same_whatever_its_process_did_before(run, tmp_path):
    cfg = toy_experiment(iterations=1, method="compass")
    stage = next(stage for stage in plan_stages(cfg) if stage.name == "compass/base")
    demonstrator = run.run_dir / run.records["generalist"].checkpoint
    ends = []
    for before in (0, 1):
        torch.manual_seed(before)
        job = toy_job(stage_cfg(cfg, stage), stage, tmp_path / str(before))
        ends.append(load_checkpoint(train(replace(job, teachers=(demonstrator,) * 3))).state)
    for end in ends:
        end["runner"].pop("wall_time")
    compare(*ends, "state")


def test_the_target_of_the_world_model_is_the_frame_that_follows(actors):
    env = DemonstrationEnv(make_env(), SpecialistBank([actors[0]] * 3), NUM_SLOTS)
    for _ in range(40):
        predicted = env.get_observations()["estimate"][:, -NUM_SLOTS:]
        before = env.get_observations()["history"][:, :NUM_SLOTS]
        obs, _, dones, _ = env.step(torch.zeros(6, NUM_SLOTS))
        expected = torch.where(dones.unsqueeze(1), before, obs["history"][:, :NUM_SLOTS])
        torch.testing.assert_close(predicted, expected)


def test_a_fresh_residual_changes_nothing_and_explores_like_the_base(actors):
    _, base, residuals = actors
    begin_residual(residuals[0], base)
    obs = make_env().get_observations()
    assert torch.equal(ResidualPolicy(base, residuals[0])(obs), mean_actions(base, obs))
    assert torch.equal(residuals[0].distribution.std_param, base.distribution.std_param)


def test_the_residual_environment_executes_base_plus_residual(actors):
    _, base, _ = actors
    plain, wrapped = make_env(), ResidualEnv(make_env(), base)
    residual = torch.randn(6, NUM_SLOTS, generator=torch.Generator().manual_seed(0))
    for _ in range(5):
        expected, _, _, _ = plain.step(mean_actions(base, plain.get_observations()) + residual)
        assert (wrapped.step(residual)[0] == expected).all()


def test_teachers_labels_are_the_actions_of_base_plus_residual(actors):
    _, base, residuals = actors
    obs = make_env().get_observations()
    labels = ResidualBank(base, residuals).label(obs.unsqueeze(0))["teacher_action"][0]
    for i, residual in enumerate(residuals):
        rows = obs["robot"] == i
        torch.testing.assert_close(labels[rows], ResidualPolicy(base, residual)(obs)[rows])


def test_imitation_stages_learn_nothing_but_imitation(run):
    metrics = (stage_dir(run.run_dir, "compass/distill") / "metrics.jsonl").read_text()
    assert "Distill/kickstart_kl" in metrics
    critics = [
        torch.load(run.run_dir / run.records[stage].checkpoint, weights_only=True)["algorithm"]["critic_state_dict"]
        for stage in ("compass/base", "compass/distill")
    ]
    assert all(torch.equal(critics[0][key], critics[1][key]) for key in critics[0]), "the critic has no part in it"


def test_what_the_learner_sets_on_a_wrapper_reaches_the_environment(actors):
    """Set on the wrapper itself, faults would not be kept and processes would not share their curriculum."""
    inner = make_env()
    inner.fault_folder = None
    inner.over_processes = None
    wrapped = ResidualEnv(inner, actors[0])
    wrapped.fault_folder, wrapped.over_processes = "faults", max
    wrapped.episode_length_buf = torch.ones(inner.num_envs, dtype=torch.long)
    assert (inner.fault_folder, inner.over_processes) == ("faults", max)
    assert inner.episode_length_buf.all()
    assert wrapped.episode_length_buf is inner.episode_length_buf
    assert not hasattr(inner, "base"), "the wrapper's own parts stay with it"


def from_root(run, **plan):
    """An experiment that forks from the run's generalist and whose critics do not learn."""
    root = run.run_dir / run.records["generalist"].checkpoint
    cfg = toy_experiment(iterations=1, judge_envs=0, method="compass", root=str(root), **plan)
    return root, replace(cfg, algo=replace(cfg.algo, critic_learning_rate=1e-12))


@pytest.mark.parametrize("base_env_steps", [0, 48])
def test_residuals_begin_with_the_demonstrators_critic_and_learning_rate_whoever_is_their_base(
    run, tmp_path, base_env_steps
):
    """A residual judged by a fresh critic, at the first learning rate, falls before it has learned anything."""
    root, cfg = from_root(run, base_env_steps=base_env_steps)
    still = replace(cfg, algo=replace(cfg.algo, desired_kl=1e9, learning_rate_range=(1e-5, 1e9)))
    result = run_experiment(still, tmp_path / "run", make_toy_env, provenance=OURS)
    learners = [torch.load(path, weights_only=True)["algorithm"] for path in (root, _final(result, "residual_one"))]
    for key, x in learners[0]["critic_state_dict"].items():
        torch.testing.assert_close(learners[1]["critic_state_dict"][key], x, msg=f"critic's {key} is not the root's")
    raised = learners[0]["learning_rate"] * LEARNING_RATE_FACTOR
    assert learners[1]["learning_rate"] == pytest.approx(raised), "raised once, from where the root's had come to"


def test_without_a_world_model_the_result_has_the_roots_shape(run, tmp_path):
    root, cfg = from_root(run, base_env_steps=0)
    result = run_experiment(cfg, tmp_path / "run", make_toy_env, provenance=OURS)
    generalist, distilled = (load_actor(path)[0].architecture for path in (root, result.generalist))
    assert distilled == generalist


def test_a_demonstrator_whose_critic_has_another_shape_is_refused_in_words(run, tmp_path):
    _, cfg = from_root(run, base_env_steps=0)
    cfg = replace(cfg, algo=replace(cfg.algo, network=replace(cfg.algo.network, critic_dims=(8,))))
    with pytest.raises(CheckpointError, match="its critic has other shapes than this experiment's"):
        run_experiment(cfg, tmp_path / "run", make_toy_env, provenance=OURS)


def _final(result, name):
    return result.run_dir / result.records[f"compass/{name}"].checkpoint
