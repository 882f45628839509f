"""What a run has reached: the tracking table of its stages, beside robots that ignore their command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from .mdp_summary import make_table

if TYPE_CHECKING:
    from eagle_rl.evaluation.evaluate import EvaluationResult
    from eagle_rl.evaluation.report import Cell, Row
    from eagle_rl.runners.plan import Stage


def _label(stage: Stage) -> str:
    """The policy a stage ends with, in words; specialists of a round share one."""
    policy = "specialist" if stage.kind == "specialist" else "generalist"
    return policy if stage.round == 0 else f"{policy}, round {stage.round}"


def stage_results(run_dir: Path, stages: Sequence[Stage]) -> dict[str, list[EvaluationResult]]:
    """The judgement of each stage that has one, by policy and in the order of the plan."""
    from eagle_rl.evaluation.evaluate import EvaluationResult
    from eagle_rl.runners.records import stage_dir

    results: dict[str, list[EvaluationResult]] = {}
    for stage in stages:
        path = stage_dir(run_dir, stage.name) / "evaluation.json"
        if path.exists():
            results.setdefault(_label(stage), []).append(EvaluationResult.read(path))
    return results


def print_tracking(results: Mapping[str, Sequence[EvaluationResult]], console: Console) -> None:
    """Print one row per robot and policy; nothing if there are no results."""
    from eagle_rl.evaluation.render import SYMBOLS, UNITS
    from eagle_rl.evaluation.report import tracking_table

    if not results:
        return
    table = tracking_table(results)
    columns = ("robot", "policy", *(f"{s} [{u}]" for s, u in zip(SYMBOLS, UNITS, strict=True)), "survival")
    console.print(make_table("Tracking errors", columns, map(_cells, table.rows)))
    console.print(f"\n{table.caption}", highlight=False)


def _cells(row: Row) -> list[str]:
    return [row.robot, row.method, *(_number(cell) for cell in row.cells), _percent(row.survival)]


def _number(cell: Cell) -> str:
    return "-" if cell.mean is None else f"{cell.mean:.3f}"


def _percent(cell: Cell | None) -> str:
    return "-" if cell is None or cell.mean is None else f"{cell.mean:.1%}"
