"""What a run's folder says about its course: learning curves and scores over rounds."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from eagle_rl.errors import ConfigError
from eagle_rl.evaluation.evaluate import EvaluationResult
from eagle_rl.evaluation.protocol import COMMANDS

STEPS = "Perf/env_steps"
LEARNING_TAGS = {
    "reward per episode": "Train/mean_reward",
    "episode length [steps]": "Train/mean_episode_length",
    "$E_{v_x}$ [m/s]": "Metrics/E_vx",
    "$E_{v_y}$ [m/s]": "Metrics/E_vy",
    r"$E_\omega$ [rad/s]": "Metrics/E_omega",
    "$E_h$ [m]": "Metrics/E_h",
    "$E_p$ [rad]": "Metrics/E_p",
    "feet that match the clock [-]": "Metrics/contact_match",
    "harness [share of full]": "Curriculum/harness",
    "cost in a search": "Search/cost",
    "survival in a search": "Search/survival",
    "$L_a$": "Distill/L_a",
    "$L_e$": "Distill/L_e",
}
"""Panels of the learning curves; each tag is followed by a robot's name."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One quantity of one robot over a stage."""

    robot: str
    env_steps: tuple[int, ...]
    """Environment steps of the stage, all robots."""
    values: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class RoundScores:
    """Tracking errors of one robot under one policy of a run."""

    robot: str
    specialist: bool
    position: float
    """Its stage's ``position`` among the rounds: a generalist at its round, 0 before the first; specialists, searched
    and corrected ones the later, before the generalist they teach; an average after it."""
    errors: tuple[float, ...]
    """Charged errors in the order of the five commands."""


def read_curves(metrics: Path, smoothing: int = 1) -> dict[str, list[Curve]]:
    """The panels of LEARNING_TAGS for which a ``metrics.jsonl`` has numbers.

    Args:
        metrics: file with one JSON object per iteration, or what :func:`curves_to_csv` wrote.
        smoothing: iterations averaged into one point.
    """
    if metrics.suffix not in (".jsonl", ".csv"):
        raise ConfigError(
            f"{metrics}: holds no curves. Name a run, the folder of a stage, its metrics.jsonl, or a .csv of curves."
        )
    try:
        lines = metrics.read_text(encoding="utf-8").splitlines()
        if metrics.suffix == ".csv":
            entries = [{key: value for key, value in row.items() if value} for row in csv.DictReader(lines)]
        else:
            entries = [json.loads(line) for line in lines if line.endswith("}")]  # the last may be half written
        panels = {title: list(_curves(entries, tag, smoothing)) for title, tag in LEARNING_TAGS.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, csv.Error) as error:
        raise ConfigError(f"{metrics}: not the numbers of a run: {error}.") from error
    return {title: curves for title, curves in panels.items() if curves}


def curves_to_csv(panels: Mapping[str, Sequence[Curve]]) -> str:
    """The numbers behind learning curves, one line per point, columns named as in a ``metrics.jsonl``."""
    columns = {
        f"{LEARNING_TAGS[title]}/{curve.robot}": dict(zip(curve.env_steps, curve.values, strict=True))
        for title, curves in panels.items()
        for curve in curves
    }
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([STEPS, *columns])
    for steps in sorted({steps for points in columns.values() for steps in points}):
        writer.writerow([steps, *(f"{points[steps]:.5g}" if steps in points else "" for points in columns.values())])
    return text.getvalue()


def _curves(entries: Sequence[dict[str, float | str]], tag: str, smoothing: int) -> Iterator[Curve]:
    """One curve per robot that has the tag."""
    keys = dict.fromkeys(key for entry in entries for key in entry if key.startswith(f"{tag}/"))
    for key in keys:
        points = [(int(e[STEPS]), float(e[key])) for e in entries if key in e and math.isfinite(float(e[key]))]
        windows = [points[i : i + smoothing] for i in range(0, len(points), smoothing)]
        if windows:
            yield Curve(
                robot=key.removeprefix(f"{tag}/"),
                env_steps=tuple(window[-1][0] for window in windows),
                values=tuple(sum(value for _, value in window) / len(window) for window in windows),
            )


def read_rounds(stages: Sequence[tuple[float, bool, Path]]) -> list[RoundScores]:
    """Scores of every judged stage of a run.

    Args:
        stages: position, whether it is a specialist, and the file of its result, for every judged stage.
    """
    scores = []
    for position, specialist, path in stages:
        for robot, metrics in EvaluationResult.read(path).robots.items():
            errors = tuple(math.nan if e is None else e for e in metrics.subsets["all"].charged)
            scores.append(RoundScores(robot=robot, specialist=specialist, position=position, errors=errors))
    if not scores:
        raise ConfigError("No stage of the run has been judged: plan.judge_envs_per_robot is 0, or none is done yet.")
    return scores


def rounds_to_csv(scores: Sequence[RoundScores]) -> str:
    """The numbers behind the rounds, one line per robot and policy; :func:`rounds_from_csv` reads them back."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["robot", "specialist", "position", *COMMANDS])
    writer.writerows([s.robot, int(s.specialist), s.position, *(f"{e:.5g}" for e in s.errors)] for s in scores)
    return text.getvalue()


def rounds_from_csv(path: Path) -> list[RoundScores]:
    """What :func:`rounds_to_csv` wrote."""
    with path.open(encoding="utf-8", newline="") as file:
        return [
            RoundScores(
                robot=row["robot"],
                specialist=row["specialist"] == "1",
                position=float(row["position"]),
                errors=tuple(float(row[name]) for name in COMMANDS),
            )
            for row in csv.DictReader(file)
        ]
