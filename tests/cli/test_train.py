"""``eagle train`` up to the first iteration: run directories, provenance, resume, refusals. Learning is faked."""

from __future__ import annotations

import json
import sys
import types
from pathlib import Path

import pytest

from eagle_rl.cli.main import run_verb
from eagle_rl.config.load import load_experiment
from eagle_rl.paths import data_root
from eagle_rl.runners.records import open_plan
from tests.policy import untrained_checkpoint


@pytest.fixture
def runs(monkeypatch):
    """Calls of the stage machine: (configuration, run directory, resume)."""
    calls = []

    def run_experiment(cfg, run_dir, make_env, resume=False, *rest, **options):
        calls.append((cfg, run_dir, resume))
        open_plan(run_dir, options["provenance"], [], resume=resume)
        return types.SimpleNamespace(run_dir=run_dir, generalist=None, records={})

    module = types.ModuleType("eagle_rl.runners.stages")
    module.run_experiment = run_experiment
    monkeypatch.setitem(sys.modules, "eagle_rl.runners.stages", module)
    return calls


def train(*words: str) -> int:
    return run_verb("train", words)


def test_a_run_directory_explains_itself(runs, capsys):
    assert train("smoke", "--seed", "7", "algo.gamma=0.9") == 0
    ((cfg, run_dir, resume),) = runs
    assert not resume
    assert run_dir.parent == Path("logs/smoke")
    assert run_dir.name.endswith("_seed7")
    assert load_experiment(str(run_dir / "config.yaml")) == cfg
    assert (cfg.seed, cfg.algo.gamma) == (7, 0.9)
    record = json.loads((run_dir / "provenance.json").read_text())
    assert record["seed"] == 7
    assert record["versions"]["mujoco"]
    assert set(record["robot_hashes"]) == set(cfg.robots)
    readme = (run_dir / "README.txt").read_text()
    assert f"eagle train --resume {run_dir}" in readme
    assert str(run_dir) in capsys.readouterr().out


def test_start_up_prints_the_whole_task(runs, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert train("smoke") == 0
    out = capsys.readouterr().out
    for part in ("lin_vel_x", "base_orientation", "projected_gravity", "sensing_latency_s", "max_pitch", "harness"):
        assert part in out


def test_two_runs_of_one_second_do_not_share_a_folder(runs):
    assert train("smoke") == 0
    assert train("smoke") == 0
    assert runs[0][1] != runs[1][1]


def test_options_may_stand_anywhere(runs):
    assert train("--out", "elsewhere", "smoke", "--seed", "3", "num_envs=20") == 0
    cfg, run_dir, _ = runs[0]
    assert (cfg.seed, cfg.num_envs, run_dir.parts[0]) == (3, 20, "elsewhere")


def test_resume_takes_the_configuration_of_the_run(runs):
    train("smoke", "algo.gamma=0.9")
    run_dir = runs[0][1]
    assert train("--resume", str(run_dir)) == 0
    assert runs[1] == (runs[0][0], run_dir, True)
    assert train("smoke", "--resume", str(run_dir)) == 0


def test_resume_refuses_another_experiment(runs, capsys):
    train("smoke")
    assert train("ppo", "--resume", str(runs[0][1])) == 2
    assert "this is a run of 'smoke', not of 'ppo'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ((), 2, "name an experiment"),
        (("pppo",), 2, "Did you mean ppo?"),
        (("ppo", "algo.gama=1"), 2, "Did you mean gamma?"),
        (("ppo", "robots=[g2]"), 3, "no robot named 'g2'. Did you mean g1?"),
        (("--resume", "nowhere"), 5, "nowhere: no such folder"),
        (("fork_ppo", "plan.root=nope.pt"), 5, "plan.root: nope.pt: no such file"),
        (("quickstart", "robots=[h1]", "plan.teachers=[nope.pt]"), 5, "plan.teachers: got 'nope.pt'"),
        (("ppo", "--resume", ".", "--scale", "paper"), 2, "keeps the scale"),
    ],
)
def test_bad_input_is_refused_in_words_and_leaves_nothing(runs, words, code, message, capsys):
    assert train(*words) == code
    assert message in capsys.readouterr().err
    assert not runs
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fork_ppo", "plan.root={}"), "has no critic to go on from"),
        (("quickstart", "robots=[t1]", "plan.teachers=[{}]"), "a policy of h1, expected one of t1"),
        (
            ("quickstart", "robots=[h1]", "plan.teachers=[{}]", "task.observations.clock_harmonics=5"),
            "sees 2 columns of clock, not 20 as this experiment shows. Add task.observations.clock_harmonics=0.",
        ),
    ],
)
def test_a_file_nothing_can_be_made_of_is_refused_before_tables_and_folders(runs, tmp_path, words, message, capsys):
    path = untrained_checkpoint(tmp_path / "files", "h1")
    assert train(*(word.format(path) for word in words)) == 5
    told = capsys.readouterr()
    assert message in told.err
    assert told.out == ""
    assert not runs
    assert [entry.name for entry in tmp_path.iterdir()] == ["files"]


def test_a_resume_that_is_refused_prints_no_tables(runs, capsys):
    train("smoke")
    capsys.readouterr()
    assert train("--resume", str(runs[0][1]), "algo.gamma=0.5") == 2
    told = capsys.readouterr()
    assert "changed since the run was begun" in told.err
    assert told.out == ""
    assert train("--resume", str(runs[0][1]), "algo.gamma=0.5", "--allow-drift") == 0


def test_a_missing_urdf_is_a_robots_fault_and_leaves_nothing(runs, tmp_path, capsys):
    source = data_root() / "cfg/robots/h1.yaml"
    text = source.read_text(encoding="utf-8").replace("../../assets/urdf/h1.urdf", "gone.urdf")
    robot = tmp_path / "mine.yaml"
    robot.write_text(text, encoding="utf-8")
    assert train("ppo", "robots=[mine.yaml]") == 3
    assert "gone.urdf" in capsys.readouterr().err
    assert list(Path().iterdir()) == [Path("mine.yaml")]


def test_two_robots_of_one_name_are_refused_and_leave_nothing(runs, capsys):
    """In logs, tables and checkpoints robots go by the names in their files."""
    source = data_root() / "cfg/robots/h1.yaml"
    urdf = (data_root() / "assets/urdf/h1.urdf").as_posix()
    text = source.read_text(encoding="utf-8").replace("../../assets/urdf/h1.urdf", urdf)
    Path("mine.yaml").write_text(text, encoding="utf-8")
    assert train("ppo", "robots=[h1, mine.yaml]") == 3
    assert "mine.yaml are both called 'h1'; expected a name of its own for each" in capsys.readouterr().err
    assert not runs


def test_a_folder_that_cannot_be_written_is_named(runs, capsys):
    Path("taken").write_text("a file")
    assert train("smoke", "--out", "taken") == 2
    assert "no run directory can be made" in capsys.readouterr().err


def test_show_prints_the_resolved_configuration_and_runs_nothing(runs, capsys):
    assert train("eagle", "--show", "algo.gamma=0.9") == 0
    Path("shown.yaml").write_text(capsys.readouterr().out)
    assert load_experiment("shown.yaml") == load_experiment("eagle", ["algo.gamma=0.9"])
    assert not runs
