"""Layers: an experiment is its base, then its own keys, then a scale, then the command line; later values win.

``base: NAME`` in any file starts from another file of the same folder. ``task: NAME`` and ``algo: NAME`` in an
experiment (or ``base:`` inside them) start that group afresh from a file in ``cfg/task`` or ``cfg/algo``. Where a name
is the path of a YAML file, it starts from the folder of the file it is written in.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from eagle_rl.errors import ConfigError, did_you_mean
from eagle_rl.paths import data_root

from .yaml_file import Node, parse_yaml, read_yaml

GROUPS = ("task", "algo")
_NOT_INHERITED = ("name", "description")


def known_names(kind: str) -> list[str]:
    """Names of the files in ``cfg/<kind>``."""
    return sorted(path.stem for path in (data_root() / "cfg" / kind).glob("*.yaml"))


def descriptions(kind: str) -> dict[str, str]:
    """The ``description`` of each file in ``cfg/<kind>``, by name; for ``--help``, which cannot wait for YAML."""
    found = {}
    for name in known_names(kind):
        text = (data_root() / "cfg" / kind / f"{name}.yaml").read_text(encoding="utf-8")
        match = re.search(r"^description:\s*(.*)$", text, flags=re.MULTILINE)
        found[name] = match[1] if match else ""
    return found


def find_file(kind: str, name: str, where: str = "command line", folder: Path = Path()) -> Path:
    """The file of a name in ``cfg/<kind>``, or of a path if ``name`` is one.

    Args:
        kind: folder under ``cfg``.
        name: name without ending, or path ending in ``.yaml``.
        where: place the name was written, for messages.
        folder: what a relative path starts from.

    Raises:
        ConfigError: there is no such file.
    """
    if name.endswith((".yaml", ".yml")):
        return folder / name
    known = known_names(kind)
    if name not in known:
        raise ConfigError(f"{where}: no {kind} named {name!r}.{did_you_mean(name, known)} Known: {', '.join(known)}.")
    return data_root() / "cfg" / kind / f"{name}.yaml"


def merge(base: Node, top: Node) -> Node:
    """``top`` over ``base``: mappings key by key, everything else replaced."""
    if not (isinstance(base.value, dict) and isinstance(top.value, dict)):
        return top
    merged = dict(base.children)
    for key, node in top.children.items():
        merged[key] = merge(merged[key], node) if key in merged else node
    return Node(merged, top.where)


def _base_name(node: Node) -> str:
    if not isinstance(node.value, str):
        raise ConfigError(f"{node.where}: base: got {node.value!r}, expected the name of a file.")
    return node.value


def load_file(kind: str, path: Path, seen: tuple[Path, ...] = ()) -> Node:
    """A file with its bases and groups resolved.

    Raises:
        ConfigError: a file is missing or damaged, or bases run in a circle.
    """
    node = read_yaml(path)
    if kind == "experiment" and not node.children:
        raise ConfigError(f"{node.where}: holds no experiment. Expected keys, such as `base: ppo`.")
    if path in seen:
        raise ConfigError(f"{node.where}: base files run in a circle: {' -> '.join(p.stem for p in (*seen, path))}.")
    base = node.children.pop("base", None)
    if base is None:
        return layer(Node({}, node.where), node, path.parent) if kind == "experiment" else node
    parent = load_file(kind, find_file(kind, _base_name(base), base.where, path.parent), (*seen, path))
    if kind != "experiment":
        return merge(parent, node)
    inherited = {key: value for key, value in parent.children.items() if key not in _NOT_INHERITED}
    return layer(Node(inherited, parent.where), node, path.parent)


def _resolve_group(kind: str, node: Node, folder: Path) -> Node | None:
    """The group started afresh from the file it names, or None if it names none."""
    name = node if isinstance(node.value, str) else node.children.get("base")
    if name is None:
        return None
    start = load_file(kind, find_file(kind, _base_name(name), name.where, folder))
    own = {key: value for key, value in node.children.items() if key != "base"}
    return merge(start, Node(own, node.where))


def layer(parent: Node, own: Node, folder: Path = Path()) -> Node:
    """An experiment's own keys, written in ``folder``, over its parent's; a group that names a file replaces that."""
    base, top = dict(parent.children), dict(own.children)
    for kind in GROUPS:
        fresh = _resolve_group(kind, top[kind], folder) if kind in top else None
        if fresh is not None:
            base.pop(kind, None)
            top[kind] = fresh
    return merge(Node(base, parent.where), Node(top, own.where))


def parse_overrides(overrides: Sequence[str]) -> Node:
    """``key.sub=value`` arguments as one layer; values are YAML scalars or lists.

    Raises:
        ConfigError: one entry per argument that cannot be read.
    """
    root = Node({}, "command line")
    faults: list[str] = []
    for text in overrides:
        key, equals, value = text.partition("=")
        parts = key.split(".")
        if not equals or not all(parts):
            faults.append(f"command line: {text!r}: expected key.sub=value, such as algo.gamma=0.99.")
            continue
        try:
            node = parse_yaml(value, f"command line: {text!r}", single_line=True) if value else Node("", "command line")
        except ConfigError as error:
            faults += error.faults
            continue
        node.where = "command line"
        for part in reversed(parts):
            node = Node({part: node}, "command line")
        root = merge(root, node)
    if faults:
        raise ConfigError(faults)
    return root
