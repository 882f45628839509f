"""From a tree of values to the schema's dataclasses: strict about types, and reporting every fault at once."""

from __future__ import annotations

import dataclasses
import types
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from eagle_rl.errors import did_you_mean

from .schema import ExperimentCfg
from .yaml_file import Node, to_plain

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")

RETIRED = {"task.control.gait_reference": 0.0, "search.randomization": False}
"""Keys of earlier versions and the value that meant off: stored configurations that say just that still load."""

_WORDS: dict[Any, str] = {bool: "true or false", int: "an integer", float: "a number", str: "text"}
_PLURALS: dict[Any, str] = {int: "integers", float: "numbers", str: "names such as [h1, g1]"}


class _MismatchError(Exception):
    """A value is not of the expected kind; carries what was expected, in words, and the nearest choice."""

    def __init__(self, expected: str, nearest: str = "") -> None:
        super().__init__(f"{expected}.{nearest}")


def hints(cls: Any) -> dict[str, Any]:
    """Field types of a schema class."""
    return get_type_hints(cls)


def leaf_paths(cls: Any, prefix: str = "") -> list[str]:
    """Dotted paths of every value a schema class holds."""
    paths: list[str] = []
    for name, hint in hints(cls).items():
        paths += leaf_paths(hint, f"{prefix}{name}.") if dataclasses.is_dataclass(hint) else [prefix + name]
    return paths


def _describe(hint: Any) -> str:
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return "one of " + ", ".join(map(str, args))
    if origin is tuple and args[-1] is Ellipsis:
        return f"a list of {_PLURALS[args[0]]}"
    if origin is tuple and len(set(args)) == 1:
        return f"a list of {len(args)} {_PLURALS[args[0]]}"
    if origin is tuple:
        return "a list of " + ", ".join(_WORDS[a] for a in args)
    if origin in (Union, types.UnionType):
        return " or ".join("null" if a is type(None) else _describe(a) for a in args)
    return _WORDS[hint]


def _sequence(value: Any, hint: Any) -> tuple[Any, ...]:
    args = get_args(hint)
    if not isinstance(value, list):
        raise _MismatchError(_describe(hint))
    items = [args[0]] * len(value) if args[-1] is Ellipsis else list(args)
    if len(items) != len(value):
        raise _MismatchError(_describe(hint))
    try:
        return tuple(convert(v, h) for v, h in zip(value, items, strict=True))
    except _MismatchError as error:
        raise _MismatchError(_describe(hint)) from error


def _number(value: Any, hint: type) -> float:
    if isinstance(value, bool) or not isinstance(value, (int,) if hint is int else (int, float)):
        raise _MismatchError(_describe(hint))
    try:
        return value if hint is int else float(value)
    except OverflowError as error:
        raise _MismatchError("a number a computer can hold") from error


def convert(value: Any, hint: Any) -> Any:
    """A YAML value as the type of a schema field.

    Raises:
        _MismatchError: the value is of another kind; nothing is guessed (no number from text, no bool from 0).
    """
    origin = get_origin(hint)
    if origin is tuple:
        return _sequence(value, hint)
    if origin in (Union, types.UnionType):
        inner = [a for a in get_args(hint) if a is not type(None)]
        return None if value is None else convert(value, inner[0])
    if origin is Literal:
        matches = isinstance(value, str) and value in get_args(hint)
    elif hint in (int, float):
        return _number(value, hint)
    else:
        matches = isinstance(value, hint)
    if not matches:
        near = did_you_mean(value, get_args(hint)) if origin is Literal and isinstance(value, str) else ""
        raise _MismatchError(_describe(hint), near)
    return value


def _unknown(path: str, key: str, siblings: list[str]) -> str:
    suggestion = did_you_mean(key, siblings)
    elsewhere = [p for p in leaf_paths(ExperimentCfg) if p.rpartition(".")[2] == key]
    if elsewhere:
        suggestion = f" Did you mean {' or '.join(elsewhere)}?"
    return f"{path}: no such key.{suggestion or ' Known here: ' + ', '.join(siblings) + '.'}"


def build(default: T, node: Node, faults: list[str], prefix: str = "") -> T:
    """Replace in ``default`` what ``node`` says.

    Args:
        default: instance of a schema class.
        node: mapping of field names to values; nested mappings for nested classes.
        faults: receives one line per fault, with place, key, got and expected.
        prefix: dotted path of ``default``, ending in a dot, or empty.

    Returns:
        The new instance; fields with faults keep their defaults.
    """
    fields = hints(type(default))
    values: dict[str, Any] = {}
    for key, child in node.children.items():
        path = prefix + key
        if path in RETIRED and to_plain(child) == RETIRED[path]:
            continue
        if key not in fields:
            faults.append(f"{child.where}: {_unknown(path, key, list(fields))}")
        elif not dataclasses.is_dataclass(fields[key]):
            try:
                values[key] = convert(to_plain(child), fields[key])
            except _MismatchError as error:
                faults.append(f"{child.where}: {path}: got {_shorten(to_plain(child))}, expected {error}")
        elif isinstance(child.value, dict):
            values[key] = build(getattr(default, key), child, faults, f"{path}.")
        else:
            faults.append(f"{child.where}: {path}: got {_shorten(child.value)}, expected keys and values.")
    return dataclasses.replace(default, **values)


def _shorten(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
