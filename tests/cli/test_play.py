"""``eagle play``, ``eagle export`` and ``eagle sim2sim`` as a user types them."""

from __future__ import annotations

import sys

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from eagle_rl.cli import export, play, sim2sim
from eagle_rl.cli.policy import load_policy
from eagle_rl.cli.session import caption
from eagle_rl.cli.window import KEYS, STOP, Keyboard
from eagle_rl.config.schema import CommandsCfg
from eagle_rl.errors import CheckpointError, ConfigError, RobotError
from eagle_rl.export.onnx import export_onnx
from eagle_rl.paths import data_root
from envs.rendering.offscreen import gl_backends
from envs.rendering.scene import default_qpos
from envs.robots.load import load_robot
from envs.sim.fault import Fault
from tests.policy import untrained_checkpoint

needs_gl = pytest.mark.skipif(not gl_backends(), reason="this machine has no EGL and no OSMesa")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return untrained_checkpoint(tmp_path_factory.mktemp("run") / "checkpoints", "h1", "t1")


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr(play, "SIZE", (160, 96))
    monkeypatch.setattr(play, "has_display", lambda: False)


@needs_gl
def test_a_video_and_a_contact_sheet_are_made_without_a_display(checkpoint, tmp_path, capsys):
    video, sheet = tmp_path / "v.mp4", tmp_path / "s.png"
    words = [str(checkpoint), "--video", str(video), "--contact-sheet", str(sheet), "--seconds", "0.4"]
    assert play.main(words) == 0
    assert imageio_ffmpeg.count_frames_and_secs(str(video))[0] == 10
    with Image.open(sheet) as picture:
        assert picture.size == (3 * 640, 4 * 384)
    told = capsys.readouterr().out
    for part in ("h1", "t1", str(video), str(sheet)):
        assert part in told


@needs_gl
def test_without_a_display_and_without_options_the_video_lies_where_one_is(checkpoint, tmp_path):
    before = sorted(checkpoint.parent.iterdir())
    assert play.main([str(checkpoint), "--robots", "t1", "--seconds", "0.1"]) == 0
    assert (tmp_path / checkpoint.with_suffix(".mp4").name).stat().st_size > 0
    assert sorted(checkpoint.parent.iterdir()) == before, "a run's checkpoints are left alone"


@pytest.mark.parametrize(
    ("words", "error", "part"),
    [
        (["--viewer", "native"], ConfigError, "--video"),
        (["--commands", "dmo"], ConfigError, "demo"),
        (["--robots", "h1,h2"], RobotError, "h2"),
        (["--robots", "h1,h1"], ConfigError, "twice"),
        (["--video", "x.avi"], ConfigError, r"\.mp4"),
        (["--contact-sheet", "x.jpg"], ConfigError, r"\.png"),
    ],
)
def test_wrong_words_are_answered_before_anything_is_filmed(checkpoint, words, error, part, tmp_path):
    with pytest.raises(error, match=part):
        play.main([str(checkpoint), *words])
    assert not list(tmp_path.iterdir())


@pytest.fixture
def played(monkeypatch):
    """What was to be filmed."""
    found = []
    monkeypatch.setattr(play, "_load", lambda args, checkpoint, seconds: found.append(checkpoint))
    monkeypatch.setattr(play, "film", lambda *args: None)
    return found


def test_it_is_said_which_policy_is_played_the_published_one_or_that_of_the_newest_run(played, tmp_path, capsys):
    with pytest.raises(CheckpointError, match="make train"):
        play.main(["--last"])
    for name in ("old", "new"):
        newest = untrained_checkpoint(tmp_path / "logs" / "ppo" / name / "checkpoints", "h1")
    assert play.main([]) == play.main(["--last"]) == 0
    assert [path.name for path in played] == [play.PUBLISHED.name, newest.name]
    told = capsys.readouterr().err
    assert "playing checkpoints/generalist.safetensors\n" in told
    assert "playing logs/ppo/new/" in told
    with pytest.raises(ConfigError, match="Give one of them"):
        play.main(["--last", str(newest)])


def test_without_viser_the_browser_view_says_what_to_install(checkpoint, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "eagle_rl.cli.browser", raising=False)
    with pytest.raises(ConfigError, match="pip install"):
        play.main([str(checkpoint), "--viewer", "web"])


def test_the_browser_gets_every_visible_shape_and_follows_the_script(checkpoint, tmp_path, capsys):
    pytest.importorskip("viser", reason="viser, the extra for the browser view, is not installed")
    script = tmp_path / "walk.yaml"
    script.write_text("- {t: 0, vx: 0.5}\n")
    words = [str(checkpoint), "--viewer", "web", "--seconds", "0.3", "--commands", str(script)]
    assert play.main(words) == 0
    assert "http://localhost" in capsys.readouterr().out


def test_a_caption_names_all_five_commands():
    assert caption(3.0, np.array([0.5, -0.1, 1.0, -0.2, 0.3])).split() == (
        "3.0 s forward +0.50 m/s left -0.10 m/s turn +1.00 rad/s height -0.20 m pitch +0.30 rad".split()
    )


def fault_file(folder):
    spec = load_robot("t1")
    qpos = np.tile(default_qpos(spec), (4, 1))
    qvel = np.zeros((4, 6 + spec.num_joints))
    qvel[2, 8] = -321.0
    qpos[3, 0] = np.nan
    arrays = {"time": np.arange(4) * 0.02, "qpos": qpos, "qvel": qvel, "ctrl": qpos[:, 7:]}
    fault = Fault(robot="t1", robot_file=str(spec.yaml_path), cause="velocity", env=5, **arrays)
    return fault.save(folder), spec.joint_names[2]


def test_a_fault_is_told_state_by_state_without_graphics(tmp_path, capsys):
    path, joint = fault_file(tmp_path)
    assert play.main(["--replay-fault", str(path)]) == 0
    told = capsys.readouterr().out.splitlines()
    assert "t1, environment 5: velocity" in told[0]
    assert f"{joint} 321.0 rad/s" in told[3]
    assert "1 numbers are not finite" in told[4]


@needs_gl
def test_the_finite_states_of_a_fault_are_drawn(tmp_path):
    path, _ = fault_file(tmp_path)
    video, sheet = tmp_path / "f.mp4", tmp_path / "f.png"
    assert play.main(["--replay-fault", str(path), "--video", str(video), "--contact-sheet", str(sheet)]) == 0
    assert imageio_ffmpeg.count_frames_and_secs(str(video))[0] == 3
    assert sheet.stat().st_size > 0


def test_keys_move_the_command_inside_its_ranges_and_enter_stands_still():
    keyboard = Keyboard(CommandsCfg())
    for code in KEYS:
        for _ in range(100):
            keyboard.press(code)
        assert (keyboard.command >= keyboard.low).all()
        assert (keyboard.command <= keyboard.high).all()
        keyboard.press(STOP)
        assert not keyboard.command.any()
    keyboard.press(265)
    keyboard.press(0)
    np.testing.assert_allclose(keyboard.command, [0.1, 0, 0, 0, 0])


def test_an_exported_policy_runs_in_plain_mujoco(checkpoint, tmp_path, capsys):
    policy = tmp_path / "p.onnx"
    assert export.main([str(checkpoint), "--out", str(policy)]) == 0
    script = tmp_path / "stand.yaml"
    script.write_text("- {t: 0}\n")
    assert sim2sim.main([str(policy), "--robot", "t1", "--commands", str(script), "--physics-dt", "0.01"]) == 0
    told = capsys.readouterr().out
    assert "E_omega" in told
    with pytest.raises(ConfigError, match="whole fraction"):
        sim2sim.main([str(policy), "--robot", "t1", "--physics-dt", "0.003"])


def test_an_export_is_named_after_its_contract_and_lies_where_one_is(checkpoint, tmp_path):
    assert export.main([str(checkpoint)]) == 0
    (found,) = tmp_path.iterdir()
    assert found.match("model_1_????????.onnx")
    assert not list(checkpoint.parent.glob("*.onnx"))


def test_a_robot_that_is_in_the_file_alone_is_asked_for_its_yaml(checkpoint, tmp_path, capsys):
    policy = tmp_path / "p.onnx"
    text = (data_root() / "cfg/robots/t1.yaml").read_text(encoding="utf-8").replace("name: t1", "name: mybot")
    (tmp_path / "mine.yaml").write_text(text.replace("../../assets", str(data_root() / "assets")), encoding="utf-8")
    loaded = load_policy(checkpoint)
    export_onnx(loaded.actor, export.build_contract(loaded.cfg, loaded.sha256, ["mine.yaml"]), policy)
    with pytest.raises(RobotError, match=r"mybot is in .*p\.onnx; plain MuJoCo needs its YAML too: --robot PATH"):
        sim2sim.main([str(policy), "--robot", "mybot"])
    with pytest.raises(RobotError, match="nobody"):
        sim2sim.main([str(policy), "--robot", "nobody"])
