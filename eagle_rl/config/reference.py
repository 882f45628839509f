"""Every key of an experiment with default, meaning, unit and source, as Markdown: ``docs/configuration.md``.

``python -m eagle_rl.config.reference > docs/configuration.md`` writes it again after a change of the schema.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import sys
from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin, get_type_hints

from .docs import field_docs
from .schema import ExperimentCfg
from .yaml_file import write_yaml

_HEAD = """\
# Configuration

Made from the docstrings of `eagle_rl/config/schema.py` and `task_schema.py` by
`python -m eagle_rl.config.reference > docs/configuration.md`; a test compares.

A key is written as `key=value` behind an experiment's name on the command line, or in an experiment's YAML, where dots
are levels. Defaults here are the schema's: files in `cfg/task`, `cfg/algo` and `cfg/experiment` say otherwise for many
keys, and `eagle train EXPERIMENT --show` prints what holds. Sources: *paper* is the EAGLE paper, *HugWBC* what it is
built on, *ours* our choice, mostly with its reason in [decisions.md](decisions.md). `[-]` is a number without unit. An
environment step is one robot's 50 Hz control step.
"""


def _default(value: Any) -> str:
    """A value as a file would have it, on one line."""
    plain = json.loads(json.dumps(dataclasses.asdict(value) if dataclasses.is_dataclass(value) else value))  # type: ignore[arg-type]
    return ", ".join(write_yaml(plain).removesuffix("...\n").strip().split("\n"))


def _choices(hint: Any) -> str:
    """What may be written instead, where the type lists it."""
    return f" One of {', '.join(f'`{c}`' for c in get_args(hint))}." if get_origin(hint) is Literal else ""


def _cell(text: str) -> str:
    """Text as the cell of a Markdown table."""
    return text.replace("``", "`").replace("|", r"\|").strip()


def _row(key: str, value: Any, hint: Any, meaning: str) -> str:
    return f"| `{key}` | `{_default(value)}` | {_cell(meaning + _choices(hint))} |"


def _sections(cfg: Any, path: str) -> Iterator[str]:
    """The group's own keys as a table, then its groups; a group that is described like a key is shown like one."""
    docs, hints = field_docs(cfg), get_type_hints(type(cfg))
    values = {field.name: getattr(cfg, field.name) for field in dataclasses.fields(cfg)}
    groups = {name: value for name, value in values.items() if dataclasses.is_dataclass(value) and name not in docs}
    rows = [_row(path + k, v, hints[k], docs.get(k, "")) for k, v in values.items() if k not in groups]
    yield f"## {path.rstrip('.') or 'The experiment'}\n\n{_cell(inspect.getdoc(type(cfg)) or '')}\n"
    if rows:
        yield "\n".join(["| key | default | meaning |", "|---|---|---|", *rows, ""])
    for name, group in groups.items():
        yield from _sections(group, f"{path}{name}.")


def reference() -> str:
    """The whole document."""
    return "\n".join([_HEAD, *_sections(ExperimentCfg(name="FILE"), "")])


if __name__ == "__main__":
    sys.stdout.write(reference())
