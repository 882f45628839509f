"""What a run makes of the checkpoint it starts from."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from eagle_rl.errors import CheckpointError
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.runners.checkpoint import load_actor, load_checkpoint
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.records import final_checkpoint
from eagle_rl.runners.root import clock_columns, open_root, widen_clock
from eagle_rl.runners.stages import run_experiment
from eagle_rl.runners.training import train
from tests.runners.toy_run import ENVS, make_toy_env, refuse, toy_experiment, toy_job


def with_harmonics(cfg, count):
    observations = replace(cfg.task.observations, clock_harmonics=count)
    return replace(cfg, task=replace(cfg.task, observations=observations))


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A toy generalist with the paper's clock."""
    cfg = toy_experiment(iterations=4, judge_envs=0, method="ppo")
    return run_experiment(cfg, tmp_path_factory.mktemp("root") / "run", make_toy_env).generalist


def continued(root, **plan):
    return with_harmonics(toy_experiment(iterations=2, judge_envs=0, root=str(root), **plan), 3)


def test_a_root_without_harmonics_acts_and_values_as_it_did(root, tmp_path, capsys):
    cfg = continued(root, method="ppo")
    wide_path = train(toy_job(cfg, plan_stages(cfg)[0], tmp_path))
    assert "warning" not in capsys.readouterr().err, "it acts as it did"
    obs, narrow_obs = (
        make_toy_env(c.robots, ENVS, c.task, seed=3).get_observations() for c in (cfg, with_harmonics(cfg, 0))
    )
    narrow, wide = load_actor(root)[0], load_actor(wide_path)[0]
    assert wide.architecture["observations"]["clock"] == obs["clock"].shape[1] == clock_columns(cfg.task.observations)
    torch.testing.assert_close(wide(obs), narrow(narrow_obs))
    old, new = (
        load_checkpoint(path).state["algorithm"]["critic_state_dict"]["mlp.0.weight"] for path in (root, wide_path)
    )
    assert torch.equal(new[:, : old.shape[1]], old)
    assert not new[:, old.shape[1] :].any()
    assert new.shape[1] == obs["critic"].shape[1]


def test_the_optimiser_expects_of_new_weights_what_it_knows_of_their_neighbours(root):
    state = load_checkpoint(root).state
    narrow, wide = (s["algorithm"]["optimizer_state_dict"]["state"] for s in (state, widen_clock(state, 10)))
    changed = [number for number in narrow if narrow[number]["exp_avg"].shape != wide[number]["exp_avg"].shape]
    algorithm = widen_clock(state, 10)["algorithm"]
    shapes = [x.shape for name in ("actor", "critic") for x in algorithm[f"{name}_state_dict"].values()]
    assert [wide[number]["exp_avg"].shape for number in sorted(wide)] == shapes, "moments of another parameter"
    assert len(changed) == 2, "the first layers of actor and critic"
    for number in changed:
        squares = narrow[number]["exp_avg_sq"]
        assert not wide[number]["exp_avg"][:, -10:].any()
        torch.testing.assert_close(wide[number]["exp_avg_sq"][:, -1], squares.mean(dim=1))
        assert torch.equal(wide[number]["exp_avg_sq"][:, :-10], squares)
        assert wide[number]["step"] == narrow[number]["step"]


def test_an_optimiser_that_has_made_no_step_has_no_moments_to_widen(root):
    state = load_checkpoint(root).state
    state["algorithm"]["optimizer_state_dict"]["state"] = {}
    algorithm = widen_clock(state, 10)["algorithm"]
    assert algorithm["optimizer_state_dict"]["state"] == {}
    narrow = state["algorithm"]["actor_state_dict"]["mlp.0.weight"]
    assert algorithm["actor_state_dict"]["mlp.0.weight"].shape[1] == narrow.shape[1] + 10


def test_training_goes_on_from_it_and_uses_what_is_new(root, tmp_path):
    cfg = continued(root, method="eagle")
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    for stage in ("round1/specialist_one", "round1/distill"):
        actor = load_actor(final_checkpoint(result.run_dir, stage))[0]
        assert actor.mlp[0].weight[:, -10:].any(), stage
    again = run_experiment(cfg, result.run_dir, make_toy_env, resume=True)
    assert again.records == result.records


def test_of_several_processes_the_first_alone_writes_a_root_that_is_changed(root, tmp_path):
    cfg = continued(root, method="ppo")
    paths = {rank: train(toy_job(cfg, plan_stages(cfg)[0], tmp_path / str(rank), rank=rank)) for rank in (0, 1)}
    assert paths[0].exists()
    assert paths[1].name == paths[0].name
    assert not paths[1].exists()


def test_a_root_that_saw_more_of_the_clock_is_refused(root, tmp_path):
    wide = run_experiment(continued(root, method="ppo"), tmp_path / "wide", make_toy_env).generalist
    cfg = toy_experiment(iterations=1, judge_envs=0, method="ppo", root=str(wide))
    told = r"plan\.root: .* sees 12 columns of clock, not 2 as .* Add task\.observations\.clock_harmonics=3\."
    with pytest.raises(CheckpointError, match=told):
        run_experiment(cfg, tmp_path / "run", refuse)
    assert not (tmp_path / "run").exists()


def test_a_root_that_estimates_or_reads_something_else_is_refused(root):
    cfg = continued(root, method="ppo")
    seen = load_actor(root)[0].architecture["observations"]
    open_root(cfg, seen | {"clock": 12})  # fewer columns of it are widened
    with pytest.raises(CheckpointError, match=f"sees {seen['estimate']} columns of estimate, not 1 as"):
        open_root(cfg, seen | {"estimate": 1})


def symmetric(cfg):
    return replace(cfg, algo=replace(cfg.algo, network=replace(cfg.algo.network, symmetric=True)))


def test_a_root_acts_on_both_sides_from_here_on_with_the_weights_it_has(root, tmp_path, capsys):
    cfg = symmetric(toy_experiment(iterations=1, judge_envs=0, method="ppo", root=str(root)))
    path = train(toy_job(cfg, plan_stages(cfg)[0], tmp_path / "there"))
    assert "algo.network.symmetric: False -> True" in capsys.readouterr().err
    before, after = load_actor(root)[0], load_actor(path)[0]
    assert before.sides is None
    assert {name: x.tolist() for name, x in after.state_dict().items()} == {
        name: x.tolist() for name, x in before.state_dict().items()
    }
    env = make_toy_env(cfg.robots, ENVS, cfg.task, seed=3)
    obs, (perm, sign) = env.get_observations(), env.mirror["actions"]
    seen = obs.clone()
    for group in ACTOR_INPUTS:
        seen[group] = obs[group][:, env.mirror[group][0]] * env.mirror[group][1]
    seen["slot_mask"] = torch.ones_like(obs["slot_mask"])
    both = 0.5 * (before(obs) + before(seen)[:, perm] * sign * obs["slot_mask"])
    torch.testing.assert_close(after(obs), both)

    back = replace(cfg, algo=toy_experiment(iterations=1).algo, plan=replace(cfg.plan, root=str(path)))
    again = train(toy_job(back, plan_stages(back)[0], tmp_path / "back"))
    assert load_actor(again)[0].sides is None


def test_every_stage_after_it_is_two_sided_too(root, tmp_path):
    cfg = symmetric(toy_experiment(iterations=2, judge_envs=0, method="eagle", root=str(root)))
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    for stage in ("round1/specialist_one", "round1/distill"):
        assert load_actor(final_checkpoint(result.run_dir, stage))[0].sides is not None, stage
