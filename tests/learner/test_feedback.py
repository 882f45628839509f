"""Directions of gains, against costs whose slopes are known."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.algorithms.feedback import descent, mirrored_gains, symmetric
from tests.learner.test_correction import MIRROR, PARTNER, normal


@given(st.integers(0, 1000))
def test_the_mirror_image_of_a_mirror_image_is_the_gains(seed: int) -> None:
    gains = normal(4, 3, 3, seed=seed)
    torch.testing.assert_close(mirrored_gains(mirrored_gains(gains, MIRROR), MIRROR), gains)
    even = symmetric(gains, MIRROR)
    torch.testing.assert_close(mirrored_gains(even, MIRROR), even)


def test_left_turns_answered_by_the_left_hip_are_right_turns_answered_by_the_right_one_half_a_cycle_later() -> None:
    """Joints 0 and 1 are twins that turn about the vertical, joint 2 bends in the middle."""
    gains = torch.zeros(3, 3)
    gains[0], gains[2] = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([4.0, 5.0, 6.0])
    image = mirrored_gains(gains, MIRROR)
    assert PARTNER.tolist() == [1, 0, 2]
    assert image[1].tolist() == [1.0, -2.0, -3.0], "an axial rate and an axial joint change sign together"
    assert image[0].tolist() == [0.0, 0.0, 0.0]
    assert image[2].tolist() == [-4.0, 5.0, 6.0], (
        "what bends forward whichever way the robot turns has no constant gain"
    )


def test_the_direction_is_downhill_of_a_cost_that_is_linear_in_the_gains() -> None:
    slope = symmetric(normal(3, 3, seed=1), MIRROR)
    change = symmetric(0.03 * normal(2000, 3, 3), MIRROR)
    difference = (change * slope).sum(dim=(1, 2)) + 0.05 * normal(2000, seed=2)
    found = descent(change, difference, MIRROR)
    torch.testing.assert_close(found.norm(), torch.tensor(1.0))
    assert -(found * slope).sum() / slope.norm() > 0.95


def test_a_cost_that_does_not_answer_moves_nothing() -> None:
    change = symmetric(normal(50, 3, 3), MIRROR)
    assert not descent(change, torch.zeros(50), MIRROR).any()
