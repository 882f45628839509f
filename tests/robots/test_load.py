"""A wrong robot file is refused in words, with every fault named; nothing but RobotError ever comes out."""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eagle_rl.config.schema import SimCfg
from eagle_rl.errors import RobotError
from envs.robots import urdf as urdf_module
from envs.robots.load import load_robot
from envs.robots.model import build_model

from .biped import NOMINAL_HEIGHT, SOLE_Z, biped_data, biped_urdf, write_biped

fuzz = settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def _refusal(folder: Path, urdf: str | None = None, data: object = None) -> str:
    with pytest.raises(RobotError) as caught:
        load_robot(write_biped(folder, urdf, data))
    return str(caught.value)


def test_a_users_robot_loads_from_its_yaml(tmp_path: Path) -> None:
    spec = load_robot(write_biped(tmp_path))
    assert spec.num_joints == 11
    assert spec.link_roles["head"] == "torso", "a fixed link stands for the body it is bolted to"
    np.testing.assert_allclose(spec.imu_offset, [0.0, 0.0, 0.3])
    np.testing.assert_allclose(spec.sole_offsets, [[0.03, 0.0, SOLE_Z]] * 2)
    assert spec.nominal_height == NOMINAL_HEIGHT


def test_unknown_name_suggests_the_nearest() -> None:
    with pytest.raises(RobotError, match=r"Unknown robot 'adm'. Did you mean adam\?.*h1.*path of a YAML"):
        load_robot("adm")


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"nowhere\.yaml: cannot be read"):
        load_robot(tmp_path / "nowhere.yaml")
    assert "lost.urdf cannot be read" in _refusal(tmp_path, data={**biped_data(), "urdf": "lost.urdf"})


def _set(*path: str, to: object) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = to

    return change


def _both(slot: str, key: str, to: object) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        for side in ("left", "right"):
            data["joints"][f"{side}_{slot}"][key] = to

    return change


def _exchange(first: str, second: str) -> Callable[[dict[str, Any]], None]:
    """Give each joint whose slot begins with one word the slot that begins with the other."""

    def change(data: dict[str, Any]) -> None:
        for entry in data["joints"].values():
            for old, new in ((first, second), (second, first)):
                if entry["slot"].startswith(old):
                    entry["slot"] = entry["slot"].replace(old, new)
                    break

    return change


def _drop(*path: str) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        for key in path[:-1]:
            data = data[key]
        del data[path[-1]]

    return change


JOINT = ("joints", "left_knee_pitch")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (_set("colour", to="red"), "unknown key 'colour'"),
        (_drop("title"), "key 'title' is missing"),
        (_set("roles", "torso", to="torzo"), "no link 'torzo' in the URDF. Did you mean torso?"),
        (_drop("roles", "head"), "roles: missing head"),
        (_set("base_link", to="torso"), "base_link is 'torso', but the URDF's root is pelvis"),
        (_set(*JOINT, "slot", to="left_kne_pitch"), "unknown slot 'left_kne_pitch'. Did you mean left_knee_pitch?"),
        (
            _set(*JOINT, "slot", to="left_hip_pitch"),
            "slot left_hip_pitch is claimed by left_hip_pitch, left_knee_pitch",
        ),
        (_drop(*JOINT), "joints: missing left_knee_pitch"),
        (_set("joints", "tail", to={}), "joints: unknown key 'tail'"),
        (_drop(*JOINT, "sign"), "joints.left_knee_pitch: missing sign"),
        (_set(*JOINT, "sign", to=2), "sign is 2, expected 1 or -1"),
        (_set(*JOINT, "stiffness_nm_per_rad", to=-5.0), "expected at least 0"),
        (_set(*JOINT, "damping_nms_per_rad", to=float("nan")), "expected a finite number"),
        (_set(*JOINT, "armature_kgm2", to="heavy"), "is 'heavy', expected a finite number"),
        (_set(*JOINT, "default_angle_rad", to=2.5), "outside its limits [-0.1, 2]"),
        (_set(*JOINT, "default_angle_rad", to=0.05), "not left/right symmetric at right_knee_pitch"),
        (_set("nominal_height_m", to=0.5), "nominal_height_m is 0.5, but in the default pose the base is 0.9100 m"),
        (_set("sole_centre_m", "left", to=[0.0, 0.0]), "sole_centre_m.left is [0.0, 0.0], expected three numbers"),
        (_set("roles", "left_foot", to="right_foot"), "roles: left_foot is at y = -0.100 m"),
        (
            _set("joints", "waist_yaw", "sign", to=-1),
            "waist_yaw: turns the other way than slot waist_yaw, expected sign 1",
        ),
        (_both("hip_pitch", "sign", -1), "right_hip_pitch: turns the other way than slot right_hip_pitch"),
        (
            _set("joints", "waist_yaw", "slot", to="waist_roll"),
            "joints.waist_yaw: turns about z (yaw), slot waist_roll is about x; exchange slots",
        ),
        (_set("roles", "pelvis", to="torso"), "waist_yaw: turns the other way than slot waist_yaw"),
        (_exchange("left_", "right_"), "slots: left_shoulder_pitch is at y = -0.200 m in the default pose"),
        (_exchange("left_hip", "left_knee"), "the thigh from left_hip_pitch to left_knee_pitch is 180 degrees off"),
        (
            _both("knee_pitch", "zero_offset_rad", 1.57),
            "shank from left_knee_pitch to left_ankle_pitch is 90 degrees off",
        ),
        (_set("name", to=["biped"]), "name is ['biped'], expected letters"),
        (_set("name", to="a/b"), "name is 'a/b', expected letters"),
        (_set(*JOINT, "slot", to={"a": 1}), "unknown slot {'a': 1}"),
        (_set("collision_excludes", to=[["torso"]]), "expected a list of pairs of links"),
        (_set("mesh_dir", to="no_such_folder"), "is not a folder"),
        (_set("urdf", to=3), "urdf is 3, expected a path"),
        (_set("urdf", to="a\0b"), "expected a path"),
        (_set("sources", to=[1]), "sources is [1], expected a mapping"),
    ],
)
def test_each_fault_in_the_yaml_has_its_sentence(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], expected: str
) -> None:
    data = biped_data()
    change(data)
    assert expected in _refusal(tmp_path, data=data)


def test_all_faults_are_listed_at_once(tmp_path: Path) -> None:
    data = biped_data()
    _set("roles", "torso", to="torzo")(data)
    _set(*JOINT, "sign", to=0)(data)
    _drop("title")(data)
    message = _refusal(tmp_path, data=data)
    assert len(message.splitlines()) == 3, message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("name: a\nname: b\n", "key 'name' is given twice"),
        ("a: &x [1]\nb: *x\n", r"aliases \(\*name\) are not allowed"),
        ("- 1\n- 2\n", "got list"),
        ("name: [", "robot.yaml:"),
        ("!!python/object/apply:os.system ['true']", "are not allowed"),
        ("[" * 5000, "nested deeper"),
    ],
)
def test_unsound_yaml_is_refused(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(RobotError, match=expected):
        load_robot(path)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('<mass value="2.0"/>', '<mass value="0"/>', "mass is 0 kg, expected more than 0"),
        ('<mass value="2.0"/>', '<mass value="-1"/>', "mass is -1 kg"),
        ('<mass value="2.0"/>', '<mass value="nan"/>', "value='nan', expected 1 finite number(s)"),
        ('<mass value="2.0"/>', '<mass value="1e9"/>', "of at most 1000"),
        (
            '<mass value="4.0"/>',
            '<mass value="0.001"/>',
            "pelvis moves but weighs 0.001 kg with all that is fixed to it",
        ),
        ('ixy="0"', 'ixy="5"', "is not that of a body"),
        ('lower="-0.1" upper="2.0"', 'lower="2.0" upper="-0.1"', "limits [2, -0.1] rad, expected lower < upper"),
        ('effort="100.0"', 'effort="0"', "must be positive"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', "has no direction"),
        ('<box size="0.1 0.1 0.3"/>', '<box size="1e9 0.1 0.3"/>', "of at most 10"),
        ('<box size="0.1 0.1 0.3"/>', '<box size="0 0.1 0.3"/>', "expected positive numbers"),
        (
            '<child link="left_shank"/>',
            '<child link="left_shnk"/>',
            "unknown child link 'left_shnk'. Did you mean left_shank?",
        ),
        ('<child link="left_shank"/>', '<child link="left_thigh"/>', "left_thigh hangs on two joints"),
        ('name="left_shank"', 'name="left_thigh"', "'left_thigh' is empty or used twice"),
        (
            '<joint name="waist_yaw" type="revolute"',
            '<joint name="waist_yaw" type="prismatic"',
            "expected revolute or fixed",
        ),
        (
            '<joint name="waist_yaw" type="revolute"',
            '<joint name="waist_yaw" type="continuous"',
            "give a continuous joint limits",
        ),
        (
            '<joint name="waist_yaw" type="revolute">',
            '<joint name="waist_yaw" type="revolute"><mimic joint="x"/>',
            "mimic",
        ),
        ("<robot", '<!DOCTYPE r [<!ENTITY a "b">]><robot', "declares a document type"),
        ("<robot", "<model><robot", "not well-formed"),
        ('<robot name="biped">', '<robot name="biped"><link name="orphan"/>', "expected exactly one, the base"),
    ],
)
def test_each_fault_in_the_urdf_has_its_sentence(tmp_path: Path, old: str, new: str, expected: str) -> None:
    text = biped_urdf()
    assert old in text
    assert expected in _refusal(tmp_path, urdf=text.replace(old, new, 1))


def test_a_loop_beside_the_base_is_refused(tmp_path: Path) -> None:
    loop = "".join(
        f'<link name="{a}"/><joint name="{a}{b}" type="fixed"><parent link="{a}"/><child link="{b}"/></joint>'
        for a, b in (("p", "q"), ("q", "p"))
    )
    assert "['p', 'q'] form a loop" in _refusal(tmp_path, urdf=biped_urdf().replace("</robot>", loop + "</robot>"))


def test_legs_that_cannot_bend_at_the_ankle_are_refused(tmp_path: Path) -> None:
    urdf, data = biped_urdf(), biped_data()
    for side in ("left", "right"):
        del data["joints"][f"{side}_ankle_pitch"]
        urdf = urdf.replace(f'"{side}_ankle_pitch" type="revolute"', f'"{side}_ankle_pitch" type="fixed"')
    assert "no joint in slots right_ankle_pitch, left_ankle_pitch; legs" in _refusal(tmp_path, urdf, data)


def test_a_foot_that_can_touch_nothing_is_refused(tmp_path: Path) -> None:
    box = '<box size="0.2 0.08 0.04"/>'
    message = _refusal(tmp_path, urdf=biped_urdf().replace(box, '<mesh filename="foot.stl"/>'))
    assert message.count("_foot, has no collision shape: its mesh is ignored, so it would sink into the ground") == 2
    assert "give it a <collision> with a box" in message


def test_sizes_are_capped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    many = "".join(f'<link name="l{i}"/>' for i in range(501))
    assert "at most 500 are read" in _refusal(tmp_path, urdf=biped_urdf().replace("</robot>", many + "</robot>"))
    monkeypatch.setattr(urdf_module, "MAX_FILE_BYTES", 100)
    assert "is larger than 100 bytes" in _refusal(tmp_path)


def test_a_name_that_mujoco_needs_is_refused_in_words(tmp_path: Path) -> None:
    urdf = biped_urdf().replace('"torso"', '"world"')
    data = yaml.safe_load(yaml.safe_dump(biped_data()).replace("torso: torso", "torso: world"))
    data["collision_excludes"] = []
    with pytest.raises(RobotError, match="MuJoCo refuses the robot"):
        build_model(load_robot(write_biped(tmp_path, urdf, data)), SimCfg())


def _load_or_refuse(path: Path) -> None:
    """Anything may happen to a mutated robot except an exception that is not a RobotError."""
    with suppress(RobotError):
        build_model(load_robot(path), SimCfg())


@fuzz
@given(
    seed=st.integers(0, 2**32), junk=st.sampled_from(["", "nan", "-1", "1e308", "x", "0 0", "<", "&", '"', "\0", "é"])
)
def test_mutated_urdfs_raise_robot_errors_only(tmp_path: Path, seed: int, junk: str) -> None:
    draw = random.Random(seed)
    text = biped_urdf()
    pieces = text.split('"')
    pieces[draw.randrange(len(pieces))] = junk
    _load_or_refuse(write_biped(tmp_path, urdf='"'.join(pieces)))


@fuzz
@given(data=st.data())
def test_mutated_yamls_raise_robot_errors_only(tmp_path: Path, data: st.DataObject) -> None:
    robot: Any = biped_data()
    at: Any = robot
    while True:
        key = data.draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
        if isinstance(at[key], dict | list) and at[key] and data.draw(st.booleans()):
            at = at[key]
            continue
        break
    scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.dates()
    at[key] = data.draw(
        st.recursive(scalars, lambda x: st.lists(x, max_size=3) | st.dictionaries(scalars, x, max_size=3))
    )
    path = write_biped(tmp_path)
    path.write_text(yaml.dump(robot), encoding="utf-8")
    _load_or_refuse(path)


@fuzz
@given(raw=st.binary(max_size=300))
def test_random_bytes_raise_robot_errors_only(tmp_path: Path, raw: bytes) -> None:
    path = write_biped(tmp_path)
    for file in (path, tmp_path / "biped.urdf"):
        kept = file.read_bytes()
        file.write_bytes(raw)
        _load_or_refuse(path)
        file.write_bytes(kept)
