"""The second look: clean robots pass, odd ones are reported, the table shows every slot."""

from __future__ import annotations

from pathlib import Path

import pytest

from envs.robots.asymmetry import asymmetries
from envs.robots.check import COLUMNS, check_robot, describe
from envs.robots.load import load_robot
from envs.robots.slots import SLOT_NAMES

from .biped import biped_data, biped_urdf, write_biped
from .vendor import ROBOTS, shipped


def test_a_symmetric_sound_robot_has_no_findings(tmp_path: Path) -> None:
    path = write_biped(tmp_path)
    assert check_robot(path) == []
    assert asymmetries(load_robot(path)) == []


@pytest.mark.parametrize("name", ROBOTS)
def test_shipped_robots_have_no_findings_but_the_vendors_asymmetries(name: str) -> None:
    odd = [finding for finding in check_robot(name) if "mirror image" not in finding]
    assert odd == []


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('<box size="0.2 0.08 0.04"/>', '<box size="0.2 0.08 0.02"/>', "the left sole centre is at z -0.06 m"),
        ('<box size="0.2 0.3 0.4"/>', '<box size="0.2 0.6 0.4"/>', "left_forearm and torso touch"),
        (
            'lower="-0.1" upper="2.0"',
            'lower="-0.1" upper="2.5"',
            "limits of left_knee_pitch: 0.5 rad (50.00%) off right_knee_pitch's mirror image",
        ),
        ('<origin xyz="0.0 0.1 -0.05"/>', '<origin xyz="0.0 0.11 -0.05"/>', "joint position of left_thigh"),
    ],
)
def test_odd_shapes_and_asymmetries_are_reported(tmp_path: Path, old: str, new: str, expected: str) -> None:
    assert old in biped_urdf()
    findings = check_robot(write_biped(tmp_path, urdf=biped_urdf().replace(old, new, 1)))
    assert any(expected in finding for finding in findings), findings


def test_tilted_soles_and_ringing_gains_are_reported(tmp_path: Path) -> None:
    data = biped_data()
    for side in ("left", "right"):
        data["joints"][f"{side}_ankle_pitch"]["default_angle_rad"] = 0.05
        data["joints"][f"{side}_knee_pitch"]["damping_nms_per_rad"] = 0.0
    findings = check_robot(write_biped(tmp_path, data=data))
    assert sum("sole is tilted by 0.050 rad" in finding for finding in findings) == 2
    assert sum("it will ring" in finding for finding in findings) == 2


@pytest.mark.parametrize(("instead", "why"), [("", ""), ('<mesh filename="torso.stl"/>', ": its mesh is ignored")])
def test_a_link_that_cannot_touch_is_reported(tmp_path: Path, instead: str, why: str) -> None:
    box = '<box size="0.2 0.3 0.4"/>'
    assert box in biped_urdf()
    findings = check_robot(write_biped(tmp_path, urdf=biped_urdf().replace(box, instead)))
    assert any(f"torso, the torso, has no collision shape{why}, so" in finding for finding in findings), findings


def test_arms_that_turn_the_other_way_or_do_not_hang_at_zero_are_reported(tmp_path: Path) -> None:
    data = biped_data()
    for side in ("left", "right"):
        data["joints"][f"{side}_elbow_pitch"] |= {"sign": -1, "zero_offset_rad": -1.57}
    findings = check_robot(write_biped(tmp_path, data=data))
    assert (
        sum("elbow_pitch: turns the other way" in finding and "expected sign 1" in finding for finding in findings) == 2
    )
    assert sum("the forearm from" in finding and "is 90 degrees off" in finding for finding in findings) == 2


@pytest.mark.parametrize("name", ROBOTS)
def test_the_table_has_a_row_per_slot_and_a_joint_in_every_slot_that_exists(name: str) -> None:
    rows = describe(shipped(name))
    assert [row[0] for row in rows] == list(SLOT_NAMES)
    assert all(len(row) == len(COLUMNS) for row in rows)
    assert {row[1] for row in rows} - {"-"} == set(shipped(name).joint_names)


def test_g1_ankles_have_the_vendors_present_torque() -> None:
    rows = {row[0]: dict(zip(COLUMNS, row, strict=True)) for row in describe(shipped("g1"))}
    assert {rows[f"{side}_ankle_{axis}"]["effort"] for side in ("left", "right") for axis in ("pitch", "roll")} == {
        "35"
    }


def test_the_documented_slot_table_is_the_one_in_the_files() -> None:
    text = (Path(__file__).parents[2] / "docs" / "robots.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[2:-1]] for line in text.splitlines() if line.startswith("| ")]
    documented = {row[0]: row[1:] for row in rows if row[0] in SLOT_NAMES}
    assert list(documented) == list(SLOT_NAMES)
    for column, name in enumerate(ROBOTS):
        for row in describe(shipped(name)):
            cells = dict(zip(COLUMNS, row, strict=True))
            cell = documented[cells["slot"]][column]
            assert cell.split(" ")[0].strip("`") == cells["joint"], f"{name} {cells['slot']}"
            assert ("sign -" in cell) == (cells["sign"] == "-" and cells["joint"] != "-"), f"{name} {cells['slot']}"
            assert ("zero" in cell) == (cells["zero"] not in ("0", "-")), f"{name} {cells['slot']}"
