"""One process against several on the same cores, the same environments in total: ``eagle bench processes``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from eagle_rl.errors import EagleError
from eagle_rl.paths import data_root

from .measure import Figure

ITERATIONS = 10
SKIPPED = 2
"""First iterations that are not counted."""


def _rate(num_envs: int, processes: int, torch_threads: int, physics_threads: int) -> float:
    """Median env-steps/s of a short run with so many environments in each process."""
    launcher = [] if processes == 1 else ["-m", "torch.distributed.run", f"--nproc-per-node={processes}"]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, *launcher, "train.py", "ppo", f"num_envs={num_envs}", "--out", folder]
        command += [f"run.torch_threads={torch_threads}", f"run.num_threads={physics_threads}"]
        command += [f"plan.generalist_env_steps={ITERATIONS * 24 * num_envs * processes}"]
        command += ["plan.judge_envs_per_robot=0", "run.save_interval=1000", "run.compile=always"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=data_root(), env=environment, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise EagleError(f"{' '.join(command)} failed:\n{done.stderr}")
        lines = next(Path(folder).rglob("metrics.jsonl")).read_text().splitlines()[SKIPPED:]
    return median(json.loads(line)["Perf/total_fps"] for line in lines)


def processes(num_envs: int, cores: int, rounds: int = 2) -> list[Figure]:
    """Whole runs: one torch thread, one a core, and a process a core; physics uses all cores in each."""
    settings = {
        "1 process, 1 torch thread": (num_envs, 1, 1, cores),
        f"1 process, {cores} torch threads": (num_envs, 1, cores, cores),
        f"{cores} processes of 1 thread": (num_envs // cores, cores, 1, 1),
    }
    rates: dict[str, list[float]] = {name: [] for name in settings}
    for _ in range(rounds):
        for name, setting in settings.items():
            rates[name].append(_rate(*setting))
    base = median(next(iter(rates.values())))
    return [
        Figure(f"{name}, {num_envs} envs", median(rate) / base, "x", "", f"{median(rate):.0f} env-steps/s")
        for name, rate in rates.items()
    ]
