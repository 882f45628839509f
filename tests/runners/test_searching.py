"""The stage that searches, on robots that do what their policy says and on the toy's."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from eagle_rl.config.schema import ExperimentCfg, SearchCfg, TaskCfg
from eagle_rl.errors import EagleWarning
from eagle_rl.evaluation.curves import read_curves
from eagle_rl.evaluation.trials import PairedTrials
from eagle_rl.runners.checkpoint import load_actor
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.records import final_checkpoint, stage_dir
from eagle_rl.runners.stages import RunResult, run_experiment
from eagle_rl.runners.training import train
from tests.runners.toy_run import JudgedToyEnv, make_toy_env, refuse, toy_experiment, toy_job

GENERATION = 2 * 4 * 5
"""Environment steps of a generation of the toy experiment."""


class StillToyEnv(JudgedToyEnv):
    """Starts with all joints at zero."""

    def _reset(self, ids: torch.Tensor) -> None:
        super()._reset(ids)
        self.frames[ids] = 0.0


def make_still_env(robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first: int = 0) -> StillToyEnv:
    return StillToyEnv(num_envs, tuple(robots), seed)


def searched(tmp_path: Path, std: float) -> tuple[ExperimentCfg, RunResult]:
    search = SearchCfg(num_pairs=64, num_steps=5, settling_steps=1, resampling_time_s=0.0, std=std, step=0.5)
    plan = toy_experiment(iterations=1, specialist_env_steps=0, search_env_steps=30 * 640)
    cfg = dataclasses.replace(plan, search=search)
    return cfg, run_experiment(cfg, tmp_path / "run", make_still_env)


def test_a_search_makes_robots_follow_better_and_touches_nothing_but_the_last_layer(tmp_path):
    cfg, result = searched(tmp_path, std=0.01)
    root = load_actor(final_checkpoint(result.run_dir, "generalist"))[0]
    for name in cfg.robots:
        actor = load_actor(final_checkpoint(result.run_dir, f"round1/search_{name}"))[0]
        trials = PairedTrials(dataclasses.replace(cfg, robots=(name,)), make_still_env, seed=99)
        before, after = (trials.follow(i, trials.commands(0), x)[0].mean().item() for i, x in enumerate((root, actor)))
        assert after < 0.7 * before, f"{name}, on commands that were not searched on"
        differ = [k for k, x in actor.state_dict().items() if not torch.equal(x, root.state_dict()[k])]
        assert differ == ["mlp.2.weight", "mlp.2.bias"], name
        assert result.records[f"round1/search_{name}"].env_steps == 30 * 640 + 3 * 64 * 5, (
            "pairs, a look before and two after"
        )


def test_a_search_that_finds_nothing_better_ends_with_what_it_began_with(tmp_path):
    """Perturbations of 0.05 carry the toys out of where their activations were."""
    with pytest.warns(EagleWarning, match=r"nothing better found. Try a smaller search.std"):
        result = searched(tmp_path, std=0.05)[1]
    root, actor = (
        load_actor(final_checkpoint(result.run_dir, name))[0] for name in ("generalist", "round1/search_one")
    )
    assert all(torch.equal(x, root.state_dict()[k]) for k, x in actor.state_dict().items())


@pytest.mark.filterwarnings("ignore:.*nothing better found")
def test_a_search_logs_every_generation_and_its_checkpoints_start_other_stages(tmp_path):
    cfg = toy_experiment(iterations=1, search_env_steps=3 * GENERATION, max_rounds=2, tolerance=0.0)
    result = run_experiment(cfg, tmp_path / "run", make_toy_env)
    folder = stage_dir(result.run_dir, "round1/search_two")
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [1, 2, 3]
    assert read_curves(folder / "metrics.jsonl").keys() == {"cost in a search", "survival in a search"}
    assert all(
        line["Search/cost"] == line["Search/cost/two"] > 0 and 0 <= line["Search/survival"] <= 1 for line in lines
    )
    assert lines[-1]["Perf/env_steps"] == GENERATION * 3 + GENERATION / 2, "a look before"
    assert result.records["round1/distill"].state == "done"


def test_only_the_first_of_several_processes_searches(tmp_path):
    cfg = toy_experiment(search_env_steps=3 * GENERATION)
    stage = next(stage for stage in plan_stages(cfg) if stage.kind == "search")
    job = toy_job(cfg, stage, tmp_path, refuse, rank=1)
    assert train(job) == tmp_path / "checkpoints" / "model_3.pt", "what the leader is going to write"
