from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.config.schema import GaitCfg
from envs.mdp.gait import (
    advance_phase,
    clock,
    clock_harmonics,
    contact_probability,
    foot_phases,
    homogenise,
    swing_target,
)

CFG = GaitCfg()
CONTACT_TABLE = {
    0.0: 0.5,
    0.025: 0.6915,
    0.05: 0.8413,
    0.1: 0.9772,
    0.15: 0.9987,
    0.2: 1.0,
    0.25: 1.0,
    0.3: 1.0,
    0.4: 0.9772,
    0.45: 0.8413,
    0.5: 0.5,
    0.55: 0.1587,
    0.6: 0.0228,
    0.65: 0.0013,
    0.75: 0.0,
    0.9: 0.0228,
    0.95: 0.1587,
    1.0 - 1e-12: 0.5,
}
"""C(phi) of HugWBC at a stance ratio of one half."""


def phases(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


@pytest.mark.parametrize(("phase", "expected"), CONTACT_TABLE.items())
def test_contact_probability_has_the_published_values(phase: float, expected: float) -> None:
    both = contact_probability(phases(phase, phase), CFG)
    assert both.tolist() == [pytest.approx([expected, expected], abs=6e-5)]


def test_contact_probability_is_half_on_average() -> None:
    cycle = (torch.arange(2000, dtype=torch.float64) + 0.5) / 2000
    assert contact_probability(cycle.unsqueeze(1), CFG).mean().item() == pytest.approx(0.5, abs=1e-6)


def test_contact_probability_follows_the_stance_ratio() -> None:
    probability = contact_probability(phases(0.35, 0.85), GaitCfg(stance_ratio=0.7))
    assert probability.tolist() == [pytest.approx([1.0, 0.0], abs=1e-4)], "middle of stance and of swing"


@given(st.floats(0.1, 0.9), st.floats(0.0, 0.999))
def test_homogenising_keeps_order_and_puts_the_change_of_phase_at_one_half(ratio: float, phase: float) -> None:
    bar = homogenise(torch.tensor([phase, ratio], dtype=torch.float64), ratio)
    assert bar[1].item() == pytest.approx(0.5)
    assert (bar[0] < 0.5).item() == (phase < ratio)
    assert 0.0 <= bar[0].item() < 1.0


def test_clock_runs_at_the_gait_frequency() -> None:
    phase = torch.zeros(1, dtype=torch.float64)
    for _ in range(50):
        phase = advance_phase(phase, 0.02, torch.tensor([1.7], dtype=torch.float64))
    assert phase.item() == pytest.approx((50 * 0.02 * 1.7) % 1.0)


@given(st.floats(0.0, 0.999))
def test_right_foot_has_the_base_phase_and_the_left_is_ahead(phase: float) -> None:
    left, right = foot_phases(phases(phase)[0], torch.tensor([False]), CFG)[0].tolist()
    assert right == phase
    assert left == pytest.approx((phase + 0.5) % 1.0)
    assert 0.0 <= left < 1.0


def test_standing_robots_keep_both_feet_in_the_middle_of_stance() -> None:
    standing = foot_phases(phases(0.8)[0], torch.tensor([True]), CFG)
    assert standing.tolist() == [[0.25, 0.25]]
    assert contact_probability(standing, CFG).tolist() == [pytest.approx([1.0, 1.0], abs=1e-6)]
    assert clock(standing).tolist() == [pytest.approx([1.0, 1.0])]


def test_harmonics_go_on_from_the_sine_the_clock_has_to_the_cosine_and_its_multiples() -> None:
    eighth, quarter, root_half = 0.125, 0.25, 0.5**0.5
    seen = clock_harmonics(phases(eighth, quarter), 2)[0].tolist()
    assert seen == [pytest.approx(x) for x in (root_half, 0.0, 1.0, 0.0, 0.0, -1.0)]  # left, right: cos, sin 2, cos 2


@given(st.floats(0.0, 0.999), st.integers(1, 6))
def test_clock_and_harmonics_together_are_the_powers_of_one_turning_hand(phase: float, count: int) -> None:
    feet = phases(phase, (phase + 0.5) % 1.0)
    pairs = torch.cat((clock(feet), clock_harmonics(feet, count)), dim=1).reshape(count, 2, 2)
    hand = torch.complex(pairs[0, 1], pairs[0, 0])
    for k in range(count):
        power = hand ** (k + 1)
        torch.testing.assert_close(torch.complex(pairs[k, 1], pairs[k, 0]), power, rtol=0, atol=1e-9)


def test_swing_target_is_the_quintic() -> None:
    height = torch.tensor([0.12], dtype=torch.float64)
    assert swing_target(phases(0.75, 0.25), height, CFG).tolist() == [pytest.approx([0.12, 0.0])]
    u = 0.5  # a quarter into swing: 10/8 - 15/16 + 6/32 = 0.5
    assert swing_target(phases(0.625, 0.875), height, CFG).tolist() == [pytest.approx([0.12 * u, 0.12 * u])]
    u = 0.2
    polynomial = 10 * u**3 - 15 * u**4 + 6 * u**5
    assert swing_target(phases(0.55, 0.95), height, CFG).tolist() == [pytest.approx([0.12 * polynomial] * 2)]


@pytest.mark.parametrize("phase", [0.5, 0.75, 1.0])
def test_swing_target_starts_peaks_and_ends_at_rest(phase: float) -> None:
    step = 1e-3
    points = (phases(phase - step, phase, phase + step) + 1e-12) % 1.0
    before, at, after = swing_target(points, torch.ones(1, dtype=torch.float64), CFG)[0].tolist()
    assert abs(after - before) / (2 * step) < 1e-3, "velocity"
    assert abs(after - 2 * at + before) / step**2 < 10.0, "acceleration; a triangle would give thousands"
