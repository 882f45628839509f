"""``eagle plot`` on a run of toy robots, and on an untrained policy where it takes the simulation."""

from __future__ import annotations

import json

import numpy as np
import pytest

from eagle_rl.cli import postures
from eagle_rl.cli.environment import make_env_factory
from eagle_rl.cli.plot import estimate_channels, main
from eagle_rl.cli.policy import load_policy
from eagle_rl.config.schema import ObservationsCfg, RandomizationCfg, RunCfg, TaskCfg
from eagle_rl.errors import ConfigError
from eagle_rl.evaluation.plots import film_strips
from eagle_rl.runners.stages import run_experiment
from envs.mdp.layout import ObservationLayout
from envs.rendering.offscreen import gl_backends
from envs.robots.embodiment import nominal_embodiment, reference_statistics
from envs.robots.load import load_robot
from tests.policy import untrained_checkpoint
from tests.runners.toy_run import make_toy_env, toy_experiment

needs_gl = pytest.mark.skipif(not gl_backends(), reason="this machine has no EGL and no OSMesa")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return untrained_checkpoint(tmp_path_factory.mktemp("policy") / "checkpoints", "t1")


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
    assert {path.name for path in tmp_path.iterdir()} == {f"rounds_toy.{suffix}" for suffix in ("png", "pdf", "csv")}
    stored, again = tmp_path / "rounds_toy.csv", tmp_path / "again"
    assert main(["rounds", f"toy={stored}", "--out", str(again)]) == 0
    assert (again / stored.name).read_text() == stored.read_text()


@pytest.mark.parametrize("figure", ["curves", "rounds", "latents"])
def test_two_paths_of_one_name_are_refused(tmp_path, figure):
    same = [f"{run}/stages/generalist" for run in "AB"]
    with pytest.raises(ConfigError, match=r"both are named 'generalist'.*NAME=PATH"):
        main([figure, *same, "--out", str(tmp_path)])


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no numbers of training there"):
        main(["curves", str(tmp_path)])


def test_channels_name_the_columns_of_the_estimate_in_order_and_give_their_units():
    channels = estimate_channels(ObservationsCfg())
    assert len(channels) == ObservationLayout(ObservationsCfg()).size("estimate")
    env = make_env_factory(RunCfg(num_threads=1))(["t1"], 1, TaskCfg(randomization=RandomizationCfg(enabled=False)), 0)
    mean = reference_statistics()[0]
    body = env.get_observations()["estimate"][0, 3:].numpy() * [c.scale for c in channels[3:]] + mean
    np.testing.assert_allclose(body, nominal_embodiment(load_robot("t1")).ravel(), rtol=1e-4, atol=1e-4)
    named = {c.name: value for c, value in zip(channels[3:], body, strict=True)}
    assert named["torso mass"] > 5.0 > named["left foot mass"] > 0.1


def test_without_embodiment_only_the_velocity_is_estimated():
    channels = estimate_channels(ObservationsCfg(embodiment_observation=False))
    assert [channel.name for channel in channels] == ["base v_x", "base v_y", "base v_z"]


def test_the_estimator_is_reported_as_figure_table_and_numbers(checkpoint, tmp_path, capsys):
    words = [f"mine={checkpoint}", "--envs", "2", "--steps", "52", "--out", str(tmp_path)]
    assert main(["estimator", *words]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        f"estimator_mine.{suffix}" for suffix in ("png", "pdf", "md", "csv", "json")
    }
    assert "| torso mass |" in capsys.readouterr().out
    stored = json.loads((tmp_path / "estimator_mine.json").read_text())
    assert (stored["samples"], stored["protocol"]["num_steps"]) == ({"t1": 2}, 52)


@needs_gl
def test_a_posture_is_shown_robot_by_robot_with_what_is_asked_and_what_is_done(checkpoint, monkeypatch):
    monkeypatch.setattr(postures, "SIZE", (48, 64))
    found = postures.strips(load_policy(checkpoint), ("t1",), "squat")
    pictures, texts = zip(*found["t1"], strict=True)
    assert [picture.shape for picture in pictures] == [(64, 48, 3)] * postures.PICTURES
    assert texts[0].startswith("0.0 s: +0.00, is ")
    assert "-0.25" in texts[2] or "fell" in texts[2]
    assert len(film_strips(found).axes) == postures.PICTURES
