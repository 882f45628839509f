"""A disk that is really full: a run in a mount of its own, small enough for two checkpoints."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

COMMON = """
import json, os, sys
from pathlib import Path
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from eagle_rl.cli.main import guarded
from eagle_rl.runners import checkpoint as ckpt, files
from eagle_rl.runners.records import stage_dir
from eagle_rl.runners.stages import run_experiment
from tests.runners.toy_run import make_toy_env, parameters, toy_experiment
disk, free = Path(sys.argv[1]), Path(sys.argv[2])
cfg = toy_experiment(iterations=6, judge_envs=2)
filler, run = disk / "filler", disk / "run"

def fill(room):
    disk_now = os.statvfs(disk)
    filler.write_bytes(bytes(disk_now.f_bavail * disk_now.f_frsize - room))

def start(resume=False):
    return guarded(lambda: run_experiment(cfg, run, make_toy_env, resume=resume) and 0)

def assert_same_as_a_run_that_had_room():
    roomy = parameters(run_experiment(cfg, free, make_toy_env))
    found = parameters(run_experiment(cfg, run, make_toy_env, resume=True))
    assert all(torch.equal(roomy[key], found[key]) for key in roomy)

def assert_whole_logs(folder):
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    board = EventAccumulator(str(folder)).Reload()
    told = [event.step for event in board.Scalars("Loss/value")] if board.Tags()["scalars"] else []
    return [row["iteration"] for row in rows], told
"""

STAYS_FULL = """
files.PATIENCE_S = 0.0
fill(5 * 150_000 // 2)
assert start() == 5
folder = stage_dir(run, "generalist")
kept = ckpt.latest_checkpoint(folder / "checkpoints")
assert 1 <= ckpt.iteration_of(kept) < 6, kept
ckpt.load_checkpoint(kept)
rows, told = assert_whole_logs(folder)
assert rows == told == list(range(1, len(rows) + 1)), (rows, told)
filler.unlink()
assert start(resume=True) == 0
assert assert_whole_logs(folder) == (list(range(1, 7)), list(range(1, 7)))
assert_same_as_a_run_that_had_room()
"""

BECOMES_FREE = """
tries, nap = [], files.time.sleep
def sleep(seconds):  # everybody's, since modules share it
    if seconds != files.RETRY_S:
        return nap(seconds)
    tries.append(seconds)
    if len(tries) == 3:
        filler.unlink()
files.time.sleep = sleep
fill(5 * 150_000 // 2)
assert start() == 0
assert len(tries) == 3
assert_same_as_a_run_that_had_room()
"""

FULL_FROM_THE_START = """
files.PATIENCE_S = 0.0
fill(0)
assert start() == 2
filler.unlink()
assert start() == 0
"""


@pytest.fixture
def on_a_small_disk(tmp_path):
    """Runs a script whose first argument is the only folder of a file system of 8 MB; returns what it said."""
    disk = tmp_path / "disk"
    disk.mkdir()
    private = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
    if shutil.which("unshare") is None:
        pytest.skip("no unshare here to mount a small disk with")
    mount = f"mount -t tmpfs -o size=8m none {disk}"
    if subprocess.run([*private, mount], capture_output=True, check=False).returncode:
        pytest.skip("mounting a small disk is not permitted here")

    def run(script: str) -> str:
        command = [*private, f'{mount} && exec "$@"', "sh", sys.executable, "-c", COMMON + script]
        done = subprocess.run(
            [*command, str(disk), str(tmp_path / "free")], cwd=ROOT, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stderr

    return run


def test_training_goes_on_and_the_last_good_checkpoint_can_be_resumed(on_a_small_disk):
    said = on_a_small_disk(STAYS_FULL)
    assert said.count("warning: ") == 1, f"once a minute:\n{said}"
    assert "No space left on device" in said
    assert "Training goes on." in said
    assert "error: " in said
    assert "can be resumed" in said


def test_a_run_waits_for_a_disk_to_become_free_and_loses_nothing(on_a_small_disk):
    said = on_a_small_disk(BECOMES_FREE)
    assert said.count("Training goes on.") == 1
    assert said.count("waits, for 10 min at most") == 1
    assert "error: " not in said


def test_a_disk_full_from_the_start_is_said_in_one_line(on_a_small_disk):
    (line,) = [line for line in on_a_small_disk(FULL_FROM_THE_START).splitlines() if line.startswith("error: ")]
    assert line.endswith("plan.json: No space left on device.")
