"""What the schema says about each of its fields: the one place of units and sources, read back for people."""

from __future__ import annotations

import ast
import inspect
from functools import cache
from typing import Any

from . import schema, task_schema


@cache
def _all_docs() -> dict[str, dict[str, str]]:
    """Docstring after each field, by class and field name."""
    docs: dict[str, dict[str, str]] = {}
    for module in (task_schema, schema):
        for node in ast.parse(inspect.getsource(module)).body:
            if isinstance(node, ast.ClassDef):
                docs[node.name] = _class_docs(node)
    return docs


def _class_docs(node: ast.ClassDef) -> dict[str, str]:
    docs: dict[str, str] = {}
    for field, after in zip(node.body, node.body[1:], strict=False):
        is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and is_text:
            docs[field.target.id] = " ".join(str(ast.literal_eval(after.value)).split())  # type: ignore[attr-defined]
    return docs


def field_docs(cfg: Any) -> dict[str, str]:
    """Docstring of each documented field of a schema class or instance."""
    cls = cfg if isinstance(cfg, type) else type(cfg)
    return _all_docs()[cls.__name__]
