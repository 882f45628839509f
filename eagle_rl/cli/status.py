"""``eagle status``: progress of a run and its stages."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.tree import Tree

    from eagle_rl.runners.status import RunStatus, StageStatus

STYLES = {
    "done": "green",
    "training": "bold cyan",
    "judging": "cyan",
    "interrupted": "yellow",
    "pending": "dim",
    "not needed": "dim",
}


def duration(seconds: float) -> str:
    """A time span for people."""
    if seconds < 60:
        return f"{math.ceil(seconds)} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"


def amount(env_steps: int) -> str:
    """A number of environment steps for people."""
    return f"{env_steps / 1e6:.2f} M" if env_steps >= 1e5 else f"{env_steps:,}"


def stage_line(status: StageStatus) -> str:
    """One stage in a line of rich markup."""
    stage = status.stage
    share = 1.0 if stage.env_steps == 0 else min(1.0, status.env_steps / stage.env_steps)
    parts = [f"[{STYLES[status.activity]}]{stage.name.split('/')[-1]:<18} {status.activity:<11}[/]"]
    if status.activity not in ("pending", "not needed"):
        parts.append(f"{share:>4.0%}  {amount(status.env_steps)} steps, {duration(status.wall_seconds)}")
    elif stage.env_steps:
        parts.append(f"      {amount(stage.env_steps)} steps planned")
    if status.score is not None:
        parts.append(f"tracking score {status.score:.3f}")
    if status.worker is not None:
        parts.append(f"by {status.worker}")
    return "  ".join(parts)


def status_tree(title: str, run: RunStatus) -> Tree:
    """The run as a tree: rounds hold their specialists and their distillation."""
    from rich.tree import Tree

    tree = Tree(f"[bold]{title}[/]  {_progress(run)}")
    rounds: dict[int, Tree] = {}
    for status in run.stages:
        number = status.stage.round
        branch = tree if number == 0 else rounds.get(number) or rounds.setdefault(number, tree.add(f"round {number}"))
        branch.add(stage_line(status))
    return tree


def _progress(run: RunStatus) -> str:
    """How far the whole run is."""
    if all(status.activity == "done" for status in run.needed):
        return f"done, {amount(run.env_steps)} environment steps in {duration(run.wall_seconds)}"
    left = "" if run.seconds_left is None else f", about {duration(run.seconds_left)} of training left"
    return f"{amount(run.env_steps)} of {amount(run.env_steps + run.env_steps_left)} environment steps{left}"


def main(argv: Sequence[str]) -> int:
    """Run ``eagle status``."""
    parser = argparse.ArgumentParser(prog="eagle status", description="Progress of a run and its stages.")
    parser.add_argument("run", type=Path, metavar="RUN", help="run directory")
    args = parser.parse_args(argv)

    from rich.console import Console

    from eagle_rl.runners.status import read_status

    console = Console(width=max(Console().width, 140))
    console.print(status_tree(str(args.run), read_status(args.run)), highlight=False)
    return 0
