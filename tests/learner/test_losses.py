"""The added losses against closed forms."""

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from eagle_rl.algorithms import losses

MASK = torch.tensor([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]])


def test_action_loss_is_a_mean_over_live_slots_only():
    difference = torch.tensor([[1.0, 2.0, 50.0, 50.0], [0.0, 0.0, 1.0, 0.0]])
    teacher = torch.randn(2, 4)
    assert losses.action_loss(teacher + difference, teacher, MASK).item() == pytest.approx((1 + 4 + 1) / 6, rel=1e-5)


def test_an_action_off_by_the_specialists_noise_is_off_by_one():
    std = torch.tensor([[0.05, 0.4, 0.0, 0.0], [0.1, 0.1, 0.2, 0.3]])  # zero in absent slots, as its label is
    units = losses.in_noise_units(std, std, MASK)
    assert torch.allclose(units, MASK), f"expected 1 in live slots and 0 in absent ones, got {units}"


def test_embedding_loss_is_a_mean_over_rows_and_dimensions():
    assert losses.embedding_loss(torch.full((3, 8), 2.0), torch.full((3, 8), 0.5)).item() == pytest.approx(2.25)


def test_estimation_loss_weighs_velocity_and_embodiment_by_their_own_means():
    error = torch.cat([torch.full((4, 3), 2.0), torch.full((4, 30), 3.0)], dim=1)
    target = torch.randn(4, 33)
    assert losses.estimation_loss(target + error, target).item() == pytest.approx(4 + 9, rel=1e-5)


@pytest.mark.parametrize("column", range(33))
def test_every_column_of_the_estimate_counts_once(column):
    error = torch.zeros(4, 33)
    error[:, column] = 3.0
    dims = 3 if column < 3 else 30
    assert losses.estimation_loss(error, torch.zeros(4, 33)).item() == pytest.approx(9 / dims)


def test_estimation_loss_without_embodiment_is_that_of_the_velocity():
    assert losses.estimation_loss(torch.ones(4, 3), torch.zeros(4, 3)).item() == pytest.approx(1.0)


def test_mirror_loss_is_zero_where_the_policy_commutes_with_the_mirror_and_only_there():
    perm, sign = torch.tensor([1, 0, 3, 2]), torch.tensor([1.0, 1.0, -1.0, -1.0])
    mean = torch.randn(2, 4)
    mirrored = mean[:, perm] * sign
    assert losses.mirror_loss(mean, mirrored, perm, sign, MASK).item() == 0.0
    off = losses.mirror_loss(mean, mirrored + 0.5, perm, sign, MASK).item()
    assert off == pytest.approx(0.25, rel=1e-5)


def test_mirror_loss_moves_only_the_mirrored_pass():
    mean, mirrored = torch.randn(2, 4, requires_grad=True), torch.randn(2, 4, requires_grad=True)
    losses.mirror_loss(mean, mirrored, torch.tensor([1, 0, 3, 2]), torch.ones(4), MASK).backward()
    assert mean.grad is None
    assert mirrored.grad.abs().sum() > 0


def test_kickstarting_loss_is_the_kl_from_specialist_to_generalist_over_live_slots():
    means, stds = torch.randn(2, 2, 4) * MASK, (torch.rand(2, 2, 4) + 0.2) * MASK
    rows = []
    for row, live in enumerate(MASK > 0):
        teacher, student = (Normal(means[i, row][live], stds[i, row][live]) for i in (0, 1))
        rows.append(kl_divergence(teacher, student).sum())
    loss = losses.kickstarting_loss(means[0], stds[0], means[1], stds[1], MASK)
    torch.testing.assert_close(loss, torch.stack(rows).mean())
