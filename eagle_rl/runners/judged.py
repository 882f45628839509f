"""The scores a run gave its own stages, and what a policy has cost."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from eagle_rl.evaluation.evaluate import EvaluationResult
from eagle_rl.runners.checkpoint import read_manifest
from eagle_rl.runners.plan import Stage
from eagle_rl.runners.records import read_plan, read_record, stage_dir

_POLICIES = {
    "specialist": "specialist",
    "residual": "specialist",
    "search": "searched specialist",
    "correct": "corrected specialist",
    "teacher": "given specialist",
    "base": "base",
    "average": "averaged",
}
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
        label = f"{_POLICIES.get(stage.kind, 'generalist')}, round {stage.round}" if stage.round else stage.name
        rows.setdefault(label, []).append(EvaluationResult.read(file))
    return rows


def training_steps(checkpoint: Path) -> int | None:
    """Environment steps spent on a run's policy: those of its stage and of all stages it was made from.

    What was spent on a root from elsewhere is not known to a run and not counted. None for a checkpoint of no run.
    """
    run_dir = next((folder for folder in checkpoint.parents if (folder / "plan.json").exists()), None)
    if run_dir is None:
        return None
    stages = {stage.name: stage for stage in read_plan(run_dir)}
    own = next((name for name in stages if stage_dir(run_dir, name) == checkpoint.parent.parent), None)
    if own is None:
        return None
    ancestry, waiting = set(), list(stages[own].inputs)
    while waiting:
        name = waiting.pop()
        ancestry.add(name)
        waiting += stages[name].inputs
    spent = 0 if stages[own].kind == "root" else read_manifest(checkpoint)["env_steps"]
    return spent + sum(read_record(run_dir, name).env_steps for name in ancestry)
