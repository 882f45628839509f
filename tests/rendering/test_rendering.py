"""The stage, frames of it, and files made of frames."""

from __future__ import annotations

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.errors import ConfigError
from envs.rendering import offscreen
from envs.rendering.offscreen import OffscreenRenderer, RenderingError, gl_backends, open_context
from envs.rendering.recorder import captioned, contact_sheet, evenly, save_picture, video_writer
from envs.rendering.scene import LANE_WIDTH, FollowCamera, Stage, default_qpos
from envs.robots.load import load_robot

needs_gl = pytest.mark.skipif(not gl_backends(), reason="this machine has no EGL and no OSMesa")


@pytest.fixture(scope="module")
def specs():
    return [load_robot(name) for name in ("h1", "t1")]


@pytest.fixture(scope="module")
def stage(specs):
    return Stage(specs)


def test_each_robot_stands_in_its_own_lane_with_its_soles_on_the_floor(stage, specs):
    stage.pose([default_qpos(spec) for spec in specs])
    np.testing.assert_allclose(np.diff(stage.root_positions()[:, 1]), LANE_WIDTH)
    for spec in specs:
        foot = stage.data.site(f"{spec.name}/left_sole")
        assert foot.xpos[2] == pytest.approx(0.0, abs=5e-3), spec.name


def test_posing_one_robot_moves_no_other(stage, specs):
    first, second = (default_qpos(spec) for spec in specs)
    stage.pose([first, second])
    before = stage.data.xpos.copy()
    first[:3] += [3.0, -1.0, 0.2]
    first[7:] += 0.1
    stage.pose([first, second])
    others = [i for i in range(stage.model.nbody) if stage.model.body(i).name.startswith("t1/")]
    np.testing.assert_array_equal(stage.data.xpos[others], before[others])
    assert not np.allclose(stage.data.body("h1/pelvis").xpos, before[stage.model.body("h1/pelvis").id])


def test_names_are_above_heads(stage, specs):
    stage.pose([default_qpos(spec) for spec in specs])
    for label, spec in zip(stage.label_positions(), specs, strict=True):
        assert label[2] > spec.nominal_height


@needs_gl
def test_a_frame_shows_the_robots_and_follows_them(stage, specs):
    qpos = [default_qpos(spec) for spec in specs]
    with OffscreenRenderer(stage, 160, 96) as renderer:
        renderer.show(qpos)
        here = renderer.frame()
        empty = [q + np.eye(len(q))[2] * 100.0 for q in qpos]
        stage.pose(empty)
        nobody = renderer.frame()
        for q in qpos:
            q[0] += 2.0
        for _ in range(600):
            renderer.show(qpos)
        there = renderer.frame()
    assert here.shape == (96, 160, 3)
    assert (np.abs(here.astype(int) - nobody).max(axis=2) > 40).mean() > 0.02, "the robots cannot be seen"
    background = np.abs(there.astype(int) - here).mean()
    assert background < 12, "2 m ahead, tiles apart, the picture should be the same"


def test_without_graphics_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setattr(offscreen, "gl_backends", lambda: ())
    with pytest.raises(RenderingError, match="apt-get install"):
        open_context(16, 16)


def test_a_video_holds_every_frame(tmp_path):
    path = tmp_path / "v.mp4"
    with video_writer(path, 64, 48, fps=25) as write:
        for value in range(30):
            write(np.full((48, 64, 3), 8 * value, np.uint8))
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert (frames, seconds) == (30, pytest.approx(1.2, abs=0.05))
    assert [p.name for p in tmp_path.iterdir()] == ["v.mp4"]


def test_a_film_that_breaks_off_leaves_the_old_file(tmp_path):
    path = tmp_path / "v.mp4"
    path.write_bytes(b"old")

    def shoot():
        with video_writer(path, 64, 48, fps=25) as write:
            write(np.zeros((48, 64, 3), np.uint8))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        shoot()
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["v.mp4"]


@pytest.mark.parametrize(("name", "part"), [("v.avi", r"\.mp4"), ("missing/v.mp4", "no folder")])
def test_a_name_that_cannot_be_written_is_refused_before_filming(tmp_path, name, part):
    with pytest.raises(ConfigError, match=part), video_writer(tmp_path / name, 64, 48, fps=25):
        pytest.fail("the film began")


def test_a_contact_sheet_lays_frames_out_row_by_row(tmp_path):
    frames = [np.full((20, 40, 3), 40 * i, np.uint8) for i in range(5)]
    sheet = contact_sheet(frames, columns=3, width=40)
    assert sheet.shape == (40, 120, 3)
    assert [int(sheet[10 + 20 * (i // 3), 20 + 40 * (i % 3), 0]) for i in range(5)] == [0, 40, 80, 120, 160]
    assert (sheet[20:, 80:] == 255).all()
    save_picture(tmp_path / "s.png", sheet)
    assert (tmp_path / "s.png").stat().st_size > 0


def test_a_caption_changes_only_the_top_of_a_frame():
    frame = np.full((300, 400, 3), 200, np.uint8)
    marked = captioned(frame, "12.0 s")
    assert (marked[:40] != frame[:40]).any()
    np.testing.assert_array_equal(marked[60:], frame[60:])


def test_frames_for_a_sheet_are_spread_from_first_to_last():
    assert evenly(101, 5) == [0, 25, 50, 75, 100]
    assert evenly(2, 12) == [0, 1]


@given(st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4)), min_size=1, max_size=5))
def test_the_camera_steps_back_until_robots_that_part_are_in_view(places):
    camera, aspect, fovy = mujoco.MjvCamera(), 16 / 9, 30.0
    follow = FollowCamera(camera, len(places), aspect, fovy)
    roots = np.array([(x, y, 1.0) for x, y in places])
    for _ in range(500):
        follow.follow(roots)
    azimuth = np.radians(camera.azimuth)
    forward, left = np.array([np.cos(azimuth), np.sin(azimuth)]), np.array([-np.sin(azimuth), np.cos(azimuth)])
    offsets = roots[:, :2] - camera.lookat[:2]
    depth = camera.distance + offsets @ forward
    assert (depth > 0).all()
    assert (np.abs(offsets @ left) < depth * aspect * np.tan(np.radians(fovy) / 2)).all()
