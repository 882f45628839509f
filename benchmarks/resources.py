"""Memory and waiting times, each measured in processes of their own."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from eagle_rl.errors import EagleError
from eagle_rl.paths import data_root

from .measure import Figure

_POLL_S = 0.05


def _python(*arguments: str) -> list[str]:
    return [sys.executable, *arguments]


def _run(command: Sequence[str]) -> str:
    """Output of a command in the checkout."""
    done = subprocess.run(command, cwd=data_root(), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise EagleError(f"{' '.join(command)} failed:\n{done.stderr}")
    return done.stdout


def build_large(num_envs: int) -> None:
    """Build and reset an environment, then print what that took; runs in a process of its own."""
    start = time.perf_counter()
    from .workloads import experiment, make_env

    make_env(experiment(0), num_envs, compiled=False).get_observations()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(json.dumps({"seconds": time.perf_counter() - start, "gigabytes": peak}))


def large(num_envs: int = 4096) -> list[Figure]:
    """Memory and start of a large environment with everything randomized."""
    code = f"from benchmarks.resources import build_large; build_large({num_envs})"
    took = json.loads(_run(_python("-c", code)))
    return [
        Figure(f"resident memory, {num_envs} envs", took["gigabytes"], "GiB", "<= 2", "peak, all imports included"),
        Figure(f"start-up, {num_envs} envs", took["seconds"], "s", "<= 20", "imports, models, randomization, reset"),
    ]


def answers(rounds: int = 5) -> list[Figure]:
    """Time until ``train.py --help`` is done."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        _run(_python("train.py", "--help"))
        times.append(time.perf_counter() - start)
    return [Figure("train.py --help", median(times), "s", "< 0.5", f"median of {rounds}, {min(times):.2f} at best")]


def first_iteration(experiment: str = "ppo") -> list[Figure]:
    """Time from the command line to the first line of metrics."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        command = _python("train.py", experiment, "--out", folder)
        with subprocess.Popen(
            command, cwd=data_root(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ
        ) as process:
            while not any(Path(folder).rglob("metrics.jsonl")) and process.poll() is None:
                time.sleep(_POLL_S)
            seconds = time.perf_counter() - start
            process.kill()
        if not any(Path(folder).rglob("metrics.jsonl")):
            raise EagleError(f"{' '.join(command)} ended without an iteration.")
    return [Figure(f"start to first iteration of {experiment}", seconds, "s", "<= 15", "")]
