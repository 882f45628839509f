from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.config.schema import RewardsCfg
from envs.mdp.curriculum import penalty_scale

CFG = RewardsCfg()
STEPS_PER_ITERATION = 24


@pytest.mark.parametrize(
    ("iteration", "expected"),
    [(0, 0.2), (99, 0.2), (100, 0.2**0.8), (400, 0.52), (1000, 0.84), (2000, 0.98)],
)
def test_penalty_scale_grows_as_published(iteration: int, expected: float) -> None:
    assert penalty_scale(CFG, iteration * STEPS_PER_ITERATION) == pytest.approx(expected, abs=5e-3)


@given(st.integers(0, 10**7), st.integers(0, 10**6))
def test_penalty_scale_never_falls_and_stays_below_one(step: int, later: int) -> None:
    assert 0.2 <= penalty_scale(CFG, step) <= penalty_scale(CFG, step + later) <= 1.0
