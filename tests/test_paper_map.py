"""The map from paper to code and the promises must not rot: every name they give exists."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import pytest

from eagle_rl.config.schema import RewardWeightsCfg

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "docs" / "paper-map.md").read_text(encoding="utf-8")
PROMISES = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
REFERENCES = sorted(set(re.findall(r"`([\w/]+\.py)::(\w+)`", TEXT + PROMISES)))


@pytest.mark.parametrize(("path", "name"), REFERENCES)
def test_every_name_in_map_and_promises_exists(path: str, name: str) -> None:
    source = (ROOT / path).read_text(encoding="utf-8")
    definition = rf"^\s*(?:def|class) {name}\b|^{name}\b\s*[:=]"
    assert re.search(definition, source, flags=re.MULTILINE), f"the docs name {name}, {path} has no such name"


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`(cfg/[\w/]+\.yaml)`", TEXT))))
def test_every_configuration_file_in_the_map_exists(path: str) -> None:
    assert (ROOT / path).is_file()


def test_every_reward_has_a_row() -> None:
    missing = [f.name for f in fields(RewardWeightsCfg) if f"envs/mdp/rewards.py::{f.name}`" not in TEXT]
    assert not missing, f"no row in docs/paper-map.md for {missing}"
