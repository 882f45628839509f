"""The task in words: every command, observation, reward, randomization and termination, with range, weight and unit."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from eagle_rl.config.docs import field_docs
from eagle_rl.config.schema import (
    AidsCfg,
    CommandsCfg,
    ObservationsCfg,
    RandomizationCfg,
    RewardsCfg,
    TaskCfg,
    TerminationsCfg,
    TerrainCfg,
)
from eagle_rl.config.validate import CONTROL_STEP

COMMAND_UNITS = {
    "lin_vel_x": "m/s",
    "lin_vel_y": "m/s",
    "ang_vel_z": "rad/s",
    "base_height": "m",
    "body_pitch": "rad",
}


def make_table(title: str, columns: Iterable[str], rows: Iterable[Iterable[str]]) -> Table:
    """A plain table for the terminal."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False, header_style="dim")
    table.min_width = len(title)
    for column in columns:
        table.add_column(escape(column), overflow="fold")
    for row in rows:
        table.add_row(*(escape(cell.replace("``", "")) for cell in row))
    return table


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_text(v) for v in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _commands(cfg: CommandsCfg) -> Table:
    ranges = {name: getattr(cfg, name) for name in COMMAND_UNITS}
    rows = [(name, _text(r.initial), _text(r.finishing), COMMAND_UNITS[name]) for name, r in ranges.items()]
    shares = f"standing with probability {cfg.standing_probability:g}, upright with {cfg.upright_probability:g}"
    title = f"Commands: drawn every {cfg.resampling_time_s:g} s, {shares}"
    return make_table(title, ("command", "initial", "finishing", "unit"), rows)


def _observations(cfg: ObservationsCfg) -> Table:
    from envs.mdp.layout import ObservationLayout

    layout = ObservationLayout(cfg)
    frame = layout.groups["history"][: len(layout.groups["history"]) // cfg.history_length]
    groups = {f"history x {cfg.history_length}": frame} | {
        name: layout.groups[name] for name in ("command", "clock", "critic", "estimate")
    }
    noise = dataclasses.asdict(cfg.noise) if cfg.enable_corruption else {}
    rows = [
        (
            group if term is terms[0] else "",
            term.name,
            str(term.size),
            _text(term.scale),
            _text(noise.get(term.name.removesuffix("_rel"), 0.0)) if group.startswith("history") else "0",
            term.unit,
        )
        for group, terms in groups.items()
        for term in terms
    ]
    return make_table("Observations", ("group", "term", "size", "scale", "noise ±", "unit"), rows)


def _rewards(cfg: RewardsCfg) -> Table:
    from envs.mdp import rewards

    weights = dataclasses.asdict(cfg.weights)
    rows = [
        (name, _text(weight), _text(weight * CONTROL_STEP), (getattr(rewards, name).__doc__ or "").split("\n")[0])
        for name, weight in weights.items()
    ]
    title = f"Rewards: orientation {cfg.orientation}, penalty factor k from {cfg.penalty_initial:g}"
    return make_table(title, ("term", "weight", "per step", "value"), rows)


def _documented(title: str, cfg: RandomizationCfg | AidsCfg | TerminationsCfg | TerrainCfg) -> Table:
    docs = field_docs(cfg)
    rows = [(f.name, _text(getattr(cfg, f.name)), docs.get(f.name, "")) for f in dataclasses.fields(cfg)]
    return make_table(title, ("key", "value", "meaning"), rows)


def randomization_table(cfg: RandomizationCfg) -> Table:
    """Every row of domain randomization with range and unit."""
    return _documented("Randomization" if cfg.enabled else "Randomization (off)", cfg)


def print_mdp(task: TaskCfg, console: Console) -> None:
    """Print the whole task as tables."""
    for table in (
        _commands(task.commands),
        _observations(task.observations),
        _rewards(task.rewards),
        _documented("Terminations", task.terminations),
        _documented("Terrain", task.terrain),
        randomization_table(task.randomization),
        _documented("Learning aids", task.aids),
    ):
        console.print(table)
        console.print()
