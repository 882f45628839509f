"""``eagle plot`` on a run of toy robots, as far as no simulation is needed."""

from __future__ import annotations

import pytest

from eagle_rl.cli.plot import main
from eagle_rl.errors import ConfigError
from eagle_rl.runners.stages import run_experiment
from tests.runners.toy_run import make_toy_env, toy_experiment


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    cfg = toy_experiment(iterations=6, judge_envs=2)
    return run_experiment(cfg, tmp_path_factory.mktemp("run"), make_toy_env)


def test_curves_are_drawn_for_every_stage(run, tmp_path, capsys):
    assert main(["curves", f"toy={run.run_dir}", "--out", str(tmp_path), "--smooth", "1"]) == 0
    names = {path.stem for path in tmp_path.glob("*.png")}
    specialists = {f"curves_toy_round1_specialist_{robot}" for robot in ("one", "two", "three")}
    assert names == {"curves_toy_generalist", "curves_toy_round1_distill", *specialists}
    assert str(tmp_path / "curves_toy_generalist.pdf") in capsys.readouterr().out


def test_rounds_are_drawn_in_one_figure(run, tmp_path):
    assert main(["rounds", f"toy={run.run_dir}", "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"rounds_toy.png", "rounds_toy.pdf"}


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        main(["curves", str(tmp_path)])
