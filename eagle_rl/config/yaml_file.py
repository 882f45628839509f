"""Strict YAML: a small, harmless subset in which every value remembers where it was written.

No tags, no aliases, no duplicate keys, a bound on size and depth; ``1e-3`` is a number and ``yes`` is text, as in
YAML 1.2. So a file can neither run code nor blow up memory, nor mean something its author did not see.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from eagle_rl.errors import ConfigError
from eagle_rl.paths import shown

MAX_BYTES = 1 << 20
MAX_DEPTH = 16


@dataclass
class Node:
    """A value and the place it was written."""

    value: Any
    """None, bool, int, float, str, list of those, or dict[str, Node]."""
    where: str
    """``file:line`` or ``command line``."""
    children: dict[str, Node] = field(init=False)
    """The value if it is a mapping, otherwise empty."""
    items: list[Node] = field(default_factory=list)
    """The entries with their places if the value is a list, otherwise empty."""

    def __post_init__(self) -> None:
        """Expose a mapping's entries without the reader having to test for one."""
        self.children = self.value if isinstance(self.value, dict) else {}


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that refuses tags and aliases and reads scalars by YAML 1.2's core schema."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 (PyYAML's own shape)
    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event: Any = self.peek_event()
        mark, problem = event.start_mark, ""
        if isinstance(event, yaml.AliasEvent):
            problem = "aliases (*name) are not allowed"
        elif getattr(event, "tag", None) is not None:
            problem = f"tags ({event.tag}) are not allowed"
        elif self.depth >= MAX_DEPTH:
            problem = f"nested deeper than {MAX_DEPTH} levels"
        if problem:
            raise yaml.MarkedYAMLError(None, None, problem, mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


class _StrictDumper(yaml.SafeDumper):
    """SafeDumper that quotes every text which either set of rules would read as something else."""


for _tag, _pattern, _first in (
    ("bool", r"true|false|True|False", "tTfF"),
    ("null", r"~|null|", "~n"),
    ("int", r"[-+]?(?:0|[1-9][0-9_]*)", "-+0123456789"),
    ("float", r"[-+]?(?:[0-9][0-9_]*\.?[0-9_]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan", "-+.0123456789"),
):
    for _class in (_StrictLoader, _StrictDumper):
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), [*_first, ""])


def _line(node: yaml.Node, source: str, single_line: bool) -> str:
    return source if single_line else f"{source}:{node.start_mark.line + 1}"


def _convert(loader: _StrictLoader, node: yaml.Node, source: str, single_line: bool) -> Node:
    where = _line(node, source, single_line)
    if isinstance(node, yaml.SequenceNode):
        items = [_convert(loader, item, source, single_line) for item in node.value]
        return Node(loader.construct_object(node, deep=True), where, items)
    if not isinstance(node, yaml.MappingNode):
        return Node(loader.construct_object(node, deep=True), where)
    entries: dict[str, Node] = {}
    for key_node, value_node in node.value:
        key = key_node.value
        if not isinstance(key_node, yaml.ScalarNode) or key_node.tag != "tag:yaml.org,2002:str":
            raise yaml.MarkedYAMLError(None, None, f"key {key!r} is not text", key_node.start_mark)
        if key in entries:
            raise yaml.MarkedYAMLError(None, None, f"key {key!r} is given twice", key_node.start_mark)
        entries[key] = _convert(loader, value_node, source, single_line)
        entries[key].where = _line(key_node, source, single_line)
    return Node(entries, where)


def parse_yaml(text: str, source: str, *, single_line: bool = False) -> Node:
    """Parse YAML text.

    Args:
        text: the YAML.
        source: name of the file, or of another origin, for messages.
        single_line: leave line numbers out of messages.

    Raises:
        ConfigError: the text is not YAML, or uses what the subset leaves out.
    """
    try:
        loader = _StrictLoader(text)
        node = loader.get_single_node()
        return Node({}, source) if node is None else _convert(loader, node, source, single_line)
    except yaml.MarkedYAMLError as error:
        mark: Any = error.problem_mark or error.context_mark
        where = source if mark is None or single_line else f"{source}:{mark.line + 1}"
        raise ConfigError(f"{where}: {error.problem or error.context}.") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{source}: not readable as YAML: {' '.join(str(error).split())}.") from error


def read_yaml(path: Path) -> Node:
    """Parse a YAML file whose top level is a mapping.

    Raises:
        ConfigError: the file cannot be read, is too large, or is not such YAML.
    """
    node = parse_yaml(read_text(path), shown(path))
    if not isinstance(node.value, dict):
        raise ConfigError(f"{shown(path)}: expected keys and values at the top level, got {type(node.value).__name__}.")
    return node


def read_text(path: Path) -> str:
    """The text of a configuration file.

    Raises:
        ConfigError: the file cannot be read, is too large, or is not UTF-8.
    """
    source = shown(path)
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
        text = raw.decode("utf-8")
    except OSError as error:
        raise ConfigError(f"{source}: cannot be read: {error.strerror or error}.") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{source}: not UTF-8 text (byte {error.start}).") from error
    if len(raw) > MAX_BYTES:
        raise ConfigError(f"{source}: larger than {MAX_BYTES} bytes; a configuration file is not.")
    return text


def write_yaml(value: Any) -> str:
    """Plain values as YAML that ``parse_yaml`` reads back unchanged."""
    return yaml.dump(
        value, Dumper=_StrictDumper, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True
    )


def to_plain(node: Node) -> Any:
    """The value without the places: dict, list and scalars."""
    return {k: to_plain(v) for k, v in node.children.items()} if isinstance(node.value, dict) else node.value
