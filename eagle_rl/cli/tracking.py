"""What a run has reached: the tracking table of its stages, beside robots that ignore their command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.console import Console

from .mdp_summary import make_table

if TYPE_CHECKING:
    from eagle_rl.evaluation.evaluate import EvaluationResult
    from eagle_rl.evaluation.report import Cell, Row


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
