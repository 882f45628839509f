"""The scores a run gave its own stages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from eagle_rl.evaluation.evaluate import EvaluationResult
from eagle_rl.runners.plan import Stage
from eagle_rl.runners.records import stage_dir

RESULT = "evaluation.json"
"""File in a stage's folder."""


def judged_stages(run_dir: Path, stages: Sequence[Stage]) -> list[tuple[Stage, Path]]:
    """Those of a run's stages that have been judged, each with the file of its result."""
    files = [(stage, stage_dir(run_dir, stage.name) / RESULT) for stage in stages]
    return [(stage, file) for stage, file in files if file.exists()]


def judged_results(run_dir: Path, stages: Sequence[Stage]) -> dict[str, list[EvaluationResult]]:
    """Results as rows of a table: the generalist, then of each round its specialists and its generalist."""
    rows: dict[str, list[EvaluationResult]] = {}
    for stage, file in judged_stages(run_dir, stages):
        policy = "specialist" if stage.specialised else "base" if stage.kind == "base" else "generalist"
        label = f"{policy}, round {stage.round}" if stage.round else stage.name
        rows.setdefault(label, []).append(EvaluationResult.read(file))
    return rows
