"""Turns of measured programs and the table made of them, without any peer."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from benchmarks.peers import contender
from benchmarks.peers.__main__ import figures
from benchmarks.peers.contender import Program, take_turns
from benchmarks.peers.turns import COLLECTION, STEP, Setting, Training
from eagle_rl.errors import EagleError
from eagle_rl.paths import data_root

PROGRAM = """
from benchmarks.peers.turns import *
print("noise")
serve(lambda setting: (About("1.0", control(2, 0.01), "1"), lambda: {STEP: 2.0 * setting.num_envs}))
"""


def test_a_peer_is_compared_with_us_by_medians_where_both_measured():
    rates = {
        "ours": [{STEP: 100.0, COLLECTION: 50.0}, {STEP: 1.0, COLLECTION: 50.0}, {STEP: 100.0, COLLECTION: 50.0}],
        "peer": [{STEP: 20.0}, {STEP: 30.0}, {STEP: 900.0}],
    }
    rows = figures(64, rates)
    assert [(row.name, row.value, row.bar) for row in rows] == [
        (f"{STEP}, 64 envs, ours", 1.0, ""),
        (f"{STEP}, 64 envs, peer", pytest.approx(0.3), "< 1"),
        (f"{COLLECTION}, 64 envs, ours", 1.0, ""),
    ]
    assert rows[1].detail == "30 env-steps/s (20 to 900)"


def test_a_program_measures_once_for_every_line_and_answers_apart_from_its_noise():
    command = [sys.executable, "-c", PROGRAM, '{"num_envs": 4, "seconds": 0.0}', "2"]
    done = subprocess.run(command, input="\n\n", capture_output=True, text=True, check=True, cwd=data_root())
    about, *turns = map(json.loads, done.stderr.splitlines())
    assert about["control"] == "50 Hz, 2 x 10 ms"
    assert turns == [{STEP: 8.0}] * 2
    assert done.stdout == "noise\n"


def test_a_peer_that_cannot_be_started_is_left_out(tmp_path):
    said: list[str] = []
    programs = [Program("broken", "no_such_program", sys.executable), Program("absent", "turns", "/no/such/python")]
    assert take_turns(programs, Setting(1, 0.0), 1, tmp_path, said.append) == ({}, {})
    assert "No module named benchmarks.peers.no_such_program" in said[1]
    assert "absent cannot be started" in said[3]


def test_a_peer_that_does_not_answer_in_time_is_ended(tmp_path, monkeypatch):
    (tmp_path / "sleepy").write_text("#!/bin/sh\nexec sleep 60\n")
    (tmp_path / "sleepy").chmod(0o755)
    monkeypatch.setattr(contender, "PATIENCE", 0.1)
    said: list[str] = []
    programs = [Program("sleeper", "turns", str(tmp_path / "sleepy"))]
    assert take_turns(programs, Setting(1, 0.0), 1, tmp_path, said.append) == ({}, {})
    assert "sleeper did not answer for 0.1 s" in said[1]


def test_without_our_rates_there_is_no_table():
    with pytest.raises(EagleError, match="could not be measured"):
        figures(64, {"ours": [], "peer": [{STEP: 1.0}]})


def test_collection_is_what_of_an_iteration_is_not_its_update(monkeypatch):
    class Runner:
        now = 0.0

        def __init__(self) -> None:
            self.alg = self

        def learn(self, iterations: int, init_at_random_ep_len: bool) -> None:
            for _ in range(iterations):
                Runner.now += 1.0
                self.update()

        def update(self) -> None:
            Runner.now += 3.0

    monkeypatch.setattr("time.perf_counter", lambda: Runner.now)
    rates = Training(Runner(), 24, Setting(num_envs=10, seconds=8.0)).rates()
    assert rates == {"collection": 240.0, "whole iteration": 60.0}
