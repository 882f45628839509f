"""The status of runs in all states."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

from eagle_rl.cli.status import main, status_tree
from eagle_rl.errors import CheckpointError
from eagle_rl.runners.claims import Claim
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.records import Record, open_plan, stage_dir, write_record
from eagle_rl.runners.status import read_status
from tests.runners.toy_run import toy_experiment

CFG = toy_experiment(max_rounds=2)


@pytest.fixture
def run_dir(tmp_path):
    """A run whose generalist is done and whose first specialist is halfway."""
    open_plan(tmp_path, Provenance(config={"plan": {"tolerance": 0.01}}), plan_stages(CFG), resume=False)
    for stage in plan_stages(CFG):
        stage_dir(tmp_path, stage.name).mkdir(parents=True)
    write_record(tmp_path, "generalist", Record(state="done", env_steps=144, wall_seconds=10.0, score=0.5))
    write_record(tmp_path, "round1/specialist_one", Record(state="training"))
    metrics = json.dumps({"Perf/env_steps": 72, "Perf/wall_time": 5.0})
    (stage_dir(tmp_path, "round1/specialist_one") / "metrics.jsonl").write_text(metrics + '\n{"Perf/env_st')
    return tmp_path


def activities(run_dir) -> dict[str, str]:
    return {s.stage.name: s.activity for s in read_status(run_dir).stages}


def test_progress_is_read_from_the_last_whole_line(run_dir):
    status = next(s for s in read_status(run_dir).stages if s.stage.name == "round1/specialist_one")
    assert (status.env_steps, status.wall_seconds) == (72, 5.0)


def test_a_stage_nobody_works_on_is_interrupted(run_dir):
    assert activities(run_dir)["round1/specialist_one"] == "interrupted"
    with Claim.acquire(stage_dir(run_dir, "round1/specialist_one")):
        assert activities(run_dir)["round1/specialist_one"] == "training"


def test_time_left_follows_from_the_speed_so_far(run_dir):
    status = read_status(run_dir)
    assert status.env_steps == 216
    assert status.env_steps_left == 144 * 9 - 216
    assert status.seconds_left == pytest.approx((144 * 9 - 216) * 15.0 / 216)


def test_rounds_after_convergence_are_not_needed(run_dir):
    for stage in plan_stages(CFG):
        if stage.round == 1:
            write_record(run_dir, stage.name, Record(state="done", env_steps=144, score=0.5))
    status = read_status(run_dir)
    assert {s.activity for s in status.stages if s.stage.round == 2} == {"not needed"}
    assert status.env_steps_left == 0


def test_the_tree_names_every_stage_once_under_its_round(run_dir):
    text = io.StringIO()
    Console(file=text, width=200).print(status_tree("run", read_status(run_dir)))
    lines = text.getvalue().splitlines()
    assert sum("specialist_two" in line for line in lines) == 2
    assert sum("── round " in line for line in lines) == 2
    assert any("specialist_one" in line and "50%" in line for line in lines)


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"no plan\.json"):
        main([str(tmp_path)])
