"""``eagle robots`` and ``eagle doctor``."""

from __future__ import annotations

import pytest

from eagle_rl.cli import doctor
from eagle_rl.cli.main import run_verb
from eagle_rl.config.compose import known_names
from eagle_rl.paths import data_root

ROBOTS = known_names("robots")


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")


def test_list_names_every_robot(capsys):
    assert run_verb("robots", ["list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ROBOTS)
    assert "mass [kg]" in out


def test_slots_show_each_robots_joint_in_each_slot(capsys):
    assert run_verb("robots", ["slots"]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert sum("right_hip_pitch" in row for row in rows) == 1
    assert len([row for row in rows if row.strip()]) == 33


@pytest.mark.parametrize("robot", ROBOTS)
def test_show_prints_every_joint_and_check_finds_the_robot_in_order(robot, capsys):
    assert run_verb("robots", ["show", robot]) == 0
    assert "left_knee_pitch" in capsys.readouterr().out
    assert run_verb("robots", ["check", robot]) == 0
    assert capsys.readouterr().out.startswith(f"{robot}: ")


def test_show_randomization_gives_the_payload_in_kilograms(capsys):
    assert run_verb("robots", ["show", "h1", "--randomization"]) == 0
    out = capsys.readouterr().out
    assert "friction" in out
    assert "from -2.99 to +8.98 kg" in out


def test_check_says_what_is_wrong_with_a_file(tmp_path, capsys):
    text = (data_root() / "cfg/robots/h1.yaml").read_text(encoding="utf-8")
    text = text.replace("../../assets", str(data_root() / "assets"))
    (tmp_path / "mine.yaml").write_text(text.replace("slot: left_knee_pitch", "slot: left_knee_roll"), encoding="utf-8")
    assert run_verb("robots", ["check", "mine.yaml"]) == 3
    message = capsys.readouterr().err
    assert "left_knee_roll" in message
    assert "Did you mean" in message


def test_an_unknown_robot_has_exit_code_3(capsys):
    assert run_verb("robots", ["show", "g2"]) == 3
    assert "Did you mean g1?" in capsys.readouterr().err


def test_doctor_finds_data_and_folder_in_order():
    assert {finding.state for finding in (*doctor.check_data(), *doctor.check_folder())} == {"ok"}


def test_doctor_says_what_is_lost_without_a_compiler(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    (finding,) = doctor.check_compiler()
    assert finding.state == "warn"
    assert "'no-such-compiler'" in finding.detail
    assert "a little slower" in finding.detail


def test_doctor_names_a_package_that_is_too_old(monkeypatch):
    monkeypatch.setattr(
        doctor, "requires", lambda name: ["numpy>=999", "no-such-package", "hypothetical; extra == 'dev'"]
    )
    findings = doctor.check_packages()
    assert [(f.name, f.state) for f in findings] == [("numpy", "FAIL"), ("no-such-package", "FAIL")]
    assert "needs >=999" in findings[0].detail


def test_doctor_fails_if_something_is_missing_and_says_how_much(monkeypatch, capsys):
    for check in ("check_packages", "check_graphics"):
        monkeypatch.setattr(doctor, check, lambda: [doctor.Finding("thing", "FAIL", "absent")])
    assert run_verb("doctor", []) == 2
    assert "2 of" in capsys.readouterr().out
