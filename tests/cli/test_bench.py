from __future__ import annotations

import json

import pytest

from benchmarks import quality, throughput
from benchmarks.measure import Figure
from eagle_rl.cli import bench
from eagle_rl.errors import EagleError


def test_an_unknown_part_is_refused_before_anything_is_measured(monkeypatch):
    monkeypatch.setattr(bench, "_measure", lambda *args: pytest.fail("measured"))
    with pytest.raises(EagleError, match="Did you mean scaling"):
        bench.main(["environment", "scalling"])


def test_settings_go_to_quality_and_nowhere_else(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(quality, "time_to_quality", lambda cfg, folder, minutes: asked.append(cfg) or [])
    words = ["robots=[t1,n1]", "--envs", "16", "algo.num_steps_per_env=48", "--run", str(tmp_path)]
    with pytest.raises(EagleError, match=r"robots=\[t1,n1\] is a setting of the part quality"):
        bench.main(["scaling", *words])
    bench.main(["quality", *words])
    assert [(cfg.robots, cfg.num_envs, cfg.algo.num_steps_per_env) for cfg in asked] == [(("t1", "n1"), 16, 48)]


@pytest.mark.parametrize(("setting", "option"), [("num_envs=128", "--envs 128"), ("run.num_threads=1", "--threads 1")])
def test_a_setting_that_an_option_says_is_refused_with_the_option(monkeypatch, setting, option):
    monkeypatch.setattr(bench, "_measure", lambda *args: pytest.fail("measured"))
    with pytest.raises(EagleError, match=f"{setting}.*Write {option}"):
        bench.main(["quality", setting])


def test_figures_come_as_a_table_and_as_json_with_the_machine(monkeypatch, capsys, tmp_path):
    figures = [Figure("speed", 0.8125, "x", ">= 0.9", "a 1 ms"), Figure("part", 0.25, "share", "", "")]
    monkeypatch.setattr(throughput, "scaling", lambda envs, seconds: figures if (envs, seconds) == (64, 2.0) else [])
    file = tmp_path / "bench.json"
    assert bench.main(["scaling", "--envs", "64", "--seconds", "2", "--threads", "1", "--json", str(file)]) == 0
    out = capsys.readouterr().out
    assert "| speed | 0.81 x | >= 0.9 | a 1 ms |" in out
    assert "| part | 25.0% |" in out
    stored = json.loads(file.read_text())
    assert [f["value"] for f in stored["figures"]] == [0.8125, 0.25]
    assert stored["machine"]["physics threads"] == "1"
    assert all(f"{name} {value}" in out for name, value in stored["machine"].items())
