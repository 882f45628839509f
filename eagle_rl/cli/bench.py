"""``eagle bench``: how fast this machine collects and learns, as ratios to what it could do at best."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from eagle_rl.errors import EagleError, did_you_mean
from eagle_rl.machine import usable_cores
from eagle_rl.paths import data_root
from eagle_rl.runners.provenance import versions

from .arguments import count, duration

if TYPE_CHECKING:
    from benchmarks.measure import Figure

PARTS: dict[str, str] = {
    "environment": "the environment step against bare physics, at 512 and 64 environments",
    "pooling": "five robots pooled against one robot at a time",
    "scaling": "two physics threads against one",
    "iteration": "collection, update and whole iterations against bare physics and bare matrix products",
    "resources": "memory and start-up of 4096 environments, --help, first iteration",
    "profile": "where the time of an iteration goes",
    "processes": "one process against a process a core, in whole runs",
    "quality": "time and steps until ppo is good, on G1 alone or as key=value says; resumed with the same --run",
}
DEFAULT = ("environment", "pooling", "scaling", "iteration", "resources")
OPTIONS = {"num_envs": "--envs", "run.num_threads": "--threads"}
"""Options that say what these settings would: the table names what an option says."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eagle bench",
        description="Measure speed and memory. Both sides of a ratio are measured in turns (`processes`: whole runs), "
        "so that other work on the machine slows both; still, leave it alone for numbers worth keeping.",
        usage="eagle bench [PART ...] [options]\n       eagle bench quality [key=value ...] [options]",
        epilog="Parts: " + "; ".join(f"{name}: {what}" for name, what in PARTS.items()) + ".",
    )
    parser.add_argument(
        "words", nargs="*", metavar="PART key=value", help=f"what to measure [{' '.join(DEFAULT)}]; settings of quality"
    )
    parser.add_argument("--envs", type=count, default=512, metavar="N", help="environments over all robots [512]")
    parser.add_argument("--threads", type=count, metavar="N", help="physics threads [one a core]")
    parser.add_argument("--seconds", type=duration, default=10.0, metavar="S", help="time for each ratio [10]")
    parser.add_argument("--minutes", type=duration, default=60.0, metavar="M", help="longest time for quality [60]")
    parser.add_argument(
        "--run", type=Path, default=Path("logs/bench_quality"), metavar="DIR", help="quality's folder [%(default)s]"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures into FILE too")
    return parser


def _told_apart(words: Sequence[str]) -> tuple[Sequence[str], list[str]]:
    """Parts, the default ones if none is named, and settings of ``quality``."""
    settings = [word for word in words if "=" in word]
    parts = [word for word in words if word not in settings] or DEFAULT
    for part in parts:
        if part not in PARTS:
            raise EagleError(f"eagle bench: no part {part!r}.{did_you_mean(part, PARTS)} Known: {', '.join(PARTS)}.")
    if settings and "quality" not in parts:
        raise EagleError(f"eagle bench: {settings[0]} is a setting of the part quality, which is not asked for.")
    for key, _, value in (setting.partition("=") for setting in settings):
        if key in OPTIONS:
            raise EagleError(f"eagle bench: {key}={value} has an option of its own. Write {OPTIONS[key]} {value}.")
    return parts, settings


def _import_benchmarks() -> None:
    """Make the ``benchmarks`` folder of a checkout importable."""
    root = data_root()
    if not (root / "benchmarks").is_dir():
        raise EagleError(
            "eagle bench: the measurements are part of the source tree and are not installed. "
            "Clone the repository and run `make bench` there."
        )
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))


def _measure(part: str, args: argparse.Namespace, settings: list[str], threads: int) -> list[Figure]:
    from benchmarks import resources, throughput
    from benchmarks.processes import processes
    from benchmarks.profile import profile
    from benchmarks.quality import quality_experiment, time_to_quality

    envs, seconds = args.envs, args.seconds

    def environment() -> list[Figure]:
        small = throughput.environment(64, threads, seconds / 2, ">= 0.80")
        return throughput.environment(envs, threads, seconds, ">= 0.90") + small

    measurements: dict[str, Callable[[], list[Figure]]] = {
        "environment": environment,
        "pooling": lambda: throughput.pooling(envs, threads, seconds),
        "scaling": lambda: throughput.scaling(envs, seconds),
        "iteration": lambda: throughput.iteration(envs, threads, max(3, round(seconds / 2))),
        "resources": lambda: resources.large() + resources.answers() + resources.first_iteration(),
        "profile": lambda: profile(envs, threads),
        "processes": lambda: processes(envs, threads),
        "quality": lambda: time_to_quality(quality_experiment(envs, threads, settings), args.run, args.minutes),
    }
    return measurements[part]()


def describe_machine(envs: int, threads: int) -> dict[str, str]:
    """What the figures depend on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": str(os.cpu_count()),
        "physics threads": str(threads),
        "envs": str(envs),
        "load": " ".join(f"{load:.1f}" for load in os.getloadavg()),
    } | versions()


def table(machine: dict[str, str], figures: Sequence[Figure]) -> str:
    """Machine and figures in Markdown."""
    about = ", ".join(f"{name} {value}" for name, value in machine.items())
    rows = [f"| {f.name} | {_shown(f)} | {f.bar} | {f.detail} |" for f in figures]
    return "\n".join([about, "", "| figure | measured | bar | medians |", "|---|---|---|---|", *rows])


def _shown(figure: Figure) -> str:
    return f"{figure.value:.1%}" if figure.unit == "share" else f"{figure.value:.2f} {figure.unit}"


def main(argv: Sequence[str]) -> int:
    """Run ``eagle bench``."""
    args = _parser().parse_intermixed_args(argv)
    parts, settings = _told_apart(args.words)
    threads = args.threads or usable_cores()
    _import_benchmarks()
    machine = describe_machine(args.envs, threads)
    figures: list[Figure] = []
    for part in parts:
        print(f"measuring: {PARTS[part]}", file=sys.stderr)
        figures += _measure(part, args, settings, threads)
    print(table(machine, figures))
    if args.json is not None:
        args.json.write_text(json.dumps({"machine": machine, "figures": [asdict(f) for f in figures]}, indent=1))
    return 0
