from __future__ import annotations

import json

import pytest

from benchmarks import throughput
from benchmarks.measure import Figure
from eagle_rl.cli import bench
from eagle_rl.errors import EagleError


def test_an_unknown_part_is_refused_before_anything_is_measured(monkeypatch):
    monkeypatch.setattr(bench, "_measure", lambda *args: pytest.fail("measured"))
    with pytest.raises(EagleError, match="Did you mean scaling"):
        bench.main(["environment", "scalling"])


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
