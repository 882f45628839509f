"""The reference of all keys is the schema's, and says something of each."""

from __future__ import annotations

from pathlib import Path

from eagle_rl.config.reference import reference

DOCUMENT = Path(__file__).parents[2] / "docs" / "configuration.md"
OF_GROUPS = ("task.rewards.weights.", "task.observations.scales.")
"""Groups whose keys are explained together."""


def test_the_committed_reference_is_what_the_schema_says():
    remedy = "python -m eagle_rl.config.reference > docs/configuration.md"
    assert DOCUMENT.read_text(encoding="utf-8") == reference(), f"the schema has changed: {remedy}"


def test_every_key_has_a_default_and_a_meaning():
    rows = [line.split(" | ") for line in reference().splitlines() if line.startswith("| `")]
    assert len(rows) > 150
    silent = [row[0] for row in rows if not row[0].startswith(tuple(f"| `{g}" for g in OF_GROUPS)) and len(row[2]) < 5]
    assert not silent, f"keys without a docstring in the schema: {silent}"
