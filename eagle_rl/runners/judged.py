"""The scores a run gave its own stages."""

from __future__ import annotations

from pathlib import Path

from eagle_rl.evaluation.evaluate import EvaluationResult
from eagle_rl.runners.plan import Stage
from eagle_rl.runners.records import read_plan, stage_dir

RESULT = "evaluation.json"
"""File in a stage's folder."""


def judged_stages(run_dir: Path) -> list[tuple[Stage, Path]]:
    """Every stage that has been judged, with the file of its result."""
    files = [(stage, stage_dir(run_dir, stage.name) / RESULT) for stage in read_plan(run_dir)]
    return [(stage, file) for stage, file in files if file.exists()]


def judged_results(run_dir: Path) -> dict[str, list[EvaluationResult]]:
    """Results as rows of a table: the generalist, then of each round its specialists and its generalist."""
    rows: dict[str, list[EvaluationResult]] = {}
    for stage, file in judged_stages(run_dir):
        if stage.kind == "specialist":
            label = f"round {stage.round} specialists"
        else:
            label = f"round {stage.round} generalist" if stage.round else stage.name
        rows.setdefault(label, []).append(EvaluationResult.read(file))
    return rows
