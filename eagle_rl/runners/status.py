"""How far a run is, read from its folder while anyone may be working on it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from eagle_rl.runners.claims import holder
from eagle_rl.runners.plan import Stage
from eagle_rl.runners.records import Record, active_stages, read_plan, read_record, read_tolerance, stage_dir

Activity = Literal["pending", "training", "judging", "done", "interrupted", "not needed"]


@dataclass(frozen=True, kw_only=True)
class StageStatus:
    """One stage."""

    stage: Stage
    activity: Activity
    """``interrupted`` was begun and has no living worker; ``not needed`` comes after convergence."""
    env_steps: int
    wall_seconds: float
    score: float | None
    worker: str | None
    """``host:pid`` of who works on it."""


@dataclass(frozen=True, kw_only=True)
class RunStatus:
    """A whole run."""

    stages: tuple[StageStatus, ...]

    @property
    def needed(self) -> list[StageStatus]:
        """Stages that are to run."""
        return [status for status in self.stages if status.activity != "not needed"]

    @property
    def env_steps(self) -> int:
        """Environment steps made."""
        return sum(status.env_steps for status in self.needed)

    @property
    def env_steps_left(self) -> int:
        """Environment steps to go, if no round converges early."""
        return sum(max(0, s.stage.env_steps - s.env_steps) for s in self.needed if s.activity != "done")

    @property
    def wall_seconds(self) -> float:
        """Training time spent, over all workers."""
        return sum(status.wall_seconds for status in self.needed)

    @property
    def seconds_left(self) -> float | None:
        """Training time to go at the present speed and number of workers; None before anything was trained."""
        workers = max(1, len({status.worker for status in self.needed if status.worker}))
        if not self.env_steps:
            return None
        return self.env_steps_left * self.wall_seconds / self.env_steps / workers


def read_status(run_dir: Path) -> RunStatus:
    """The status of the run in a folder."""
    stages = read_plan(run_dir)
    records = {stage.name: read_record(run_dir, stage.name) for stage in stages}
    active = {stage.name for stage in active_stages(stages, records, read_tolerance(run_dir))}
    return RunStatus(
        stages=tuple(_stage_status(run_dir, stage, records[stage.name], stage.name in active) for stage in stages)
    )


def _stage_status(run_dir: Path, stage: Stage, record: Record, active: bool) -> StageStatus:
    """One stage's status."""
    folder = stage_dir(run_dir, stage.name)
    worker = holder(folder)
    env_steps, wall_seconds = record.env_steps, record.wall_seconds
    if record.state == "training":
        env_steps, wall_seconds = _progress(folder / "metrics.jsonl")
    activity: Activity = record.state
    if not active:
        activity = "not needed"
    elif record.state in ("training", "judging") and worker is None:
        activity = "interrupted"
    return StageStatus(
        stage=stage,
        activity=activity,
        env_steps=env_steps,
        wall_seconds=wall_seconds,
        score=record.score,
        worker=worker,
    )


def _progress(metrics: Path) -> tuple[int, float]:
    """Environment steps and wall seconds of the last whole line."""
    lines = metrics.read_text(encoding="utf-8").splitlines() if metrics.exists() else []
    entries = (_entry(line) for line in reversed(lines))
    return next((entry for entry in entries if entry is not None), (0, 0.0))


def _entry(line: str) -> tuple[int, float] | None:
    """Steps and seconds of a line; None of one that is just being written."""
    try:
        entry = json.loads(line)
        return int(entry["Perf/env_steps"]), float(entry["Perf/wall_time"])
    except (ValueError, KeyError):
        return None
