"""The one loader: names, files and command-line overrides in, one checked ``ExperimentCfg`` out."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eagle_rl.errors import ConfigError, RobotError, did_you_mean
from eagle_rl.paths import shown

from .build import build
from .compose import find_file, known_names, layer, load_file, parse_overrides
from .schema import ExperimentCfg
from .validate import find_faults
from .yaml_file import Node, parse_yaml, read_yaml, write_yaml


def load_experiment(name_or_path: str, overrides: Sequence[str] = (), scale: str | None = None) -> ExperimentCfg:
    """Load an experiment and check all of it.

    Args:
        name_or_path: name of a file in ``cfg/experiment``, or path of a YAML file, such as a run's ``config.yaml``.
        overrides: ``key.sub=value`` arguments; they win over files.
        scale: name of a file in ``cfg/scale`` laid over the experiment, before the overrides.

    Raises:
        ConfigError: something is wrong; lists every fault with file, key, got, expected and nearest spelling.
        RobotError: everything is well but the name of a robot.
    """
    path = find_file("experiment", name_or_path)
    tree = load_file("experiment", path)
    if scale is not None:
        scale_path = find_file("scale", scale)
        tree = layer(tree, read_yaml(scale_path), scale_path.parent)
    tree = layer(tree, parse_overrides(overrides))
    tree.children.setdefault("name", Node(path.stem, shown(path)))
    faults: list[str] = []
    cfg = build(ExperimentCfg(name=path.stem), tree, faults)
    faults += [f"{_place(tree, key)}: {key}: {text}." for key, text in find_faults(cfg)]
    strangers = _unknown_robots(tree, cfg)
    if faults:
        raise ConfigError(faults + strangers)
    if strangers:
        raise RobotError("\n".join(strangers))
    return cfg


def experiment_from_plain(values: Mapping[str, Any], source: str) -> ExperimentCfg:
    """The experiment whose resolved values were stored, such as those in a checkpoint's manifest.

    Args:
        values: plain nested values, as ``config.yaml`` holds them.
        source: where they come from, for messages.

    Raises:
        ConfigError: they do not fit this version's schema; lists every fault.
    """
    faults: list[str] = []
    cfg = build(ExperimentCfg(name="stored"), parse_yaml(json.dumps(values), source, single_line=True), faults)
    if faults:
        raise ConfigError(faults)
    return cfg


def _place(tree: Node, key: str) -> str:
    """Where the value of a key was written, or the nearest thing to it that was."""
    node = tree
    for part in key.split("."):
        if part not in node.children:
            break
        node = node.children[part]
    return node.where


def _unknown_robots(tree: Node, cfg: ExperimentCfg) -> list[str]:
    known = known_names("robots")
    return [
        f"{_place(tree, 'robots')}: robots: no robot named {name!r}.{did_you_mean(name, known)} "
        f"Known: {', '.join(known)}, or the path of a robot's YAML file."
        for name in cfg.robots
        if name not in known and not (name.endswith((".yaml", ".yml")) and Path(name).is_file())
    ]


def _plain(value: Any) -> Any:
    """Dataclasses as dicts and tuples as lists, all the way down."""
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def to_yaml(cfg: ExperimentCfg) -> str:
    """The resolved configuration: every value, readable again by ``load_experiment``."""
    return write_yaml(_plain(cfg))
