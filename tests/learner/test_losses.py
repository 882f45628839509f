"""The added losses against closed forms."""

import pytest
import torch

from eagle_rl.algorithms import losses
from eagle_rl.models.distribution import kl_divergence

MASK = torch.tensor([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]])


LIVE = MASK.sum() / len(MASK)


def test_the_surrogate_is_ppo_s_clipped_one():
    ratio = torch.tensor([0.5, 0.9, 1.3, 0.5, 1.1, 1.3])
    advantage = torch.tensor([1.0, 1.0, 1.0, -2.0, -2.0, -2.0])
    rows = losses.surrogate_loss(ratio.log(), advantage, 0.2)
    expected = torch.tensor([-0.5, -0.9, -1.2, 1.6, 2.2, 2.6])
    torch.testing.assert_close(rows, expected, msg=lambda m: f"gains are bounded at a ratio of 1.2, harm never: {m}")


def test_the_value_loss_is_the_squared_error_and_clipped_the_larger_one():
    value, target, old = torch.tensor([1.0, 1.0]), torch.tensor([2.0, 0.9]), torch.tensor([0.0, 0.0])
    torch.testing.assert_close(losses.value_loss(value, target, old), torch.tensor([1.0, 0.01]))
    torch.testing.assert_close(losses.value_loss(value, target, old, 0.2), torch.tensor([1.8**2, 0.7**2]))


def test_action_loss_is_a_mean_over_live_slots_only():
    difference = torch.tensor([[1.0, 2.0, 50.0, 50.0], [0.0, 0.0, 1.0, 0.0]])
    teacher = torch.randn(2, 4)
    rows = losses.action_loss(teacher + difference, teacher, MASK, LIVE)
    assert rows.mean().item() == pytest.approx((1 + 4 + 1) / 6, rel=1e-5)


def test_losses_are_one_number_a_row_and_a_row_changes_only_its_own():
    policy = [torch.randn(2, 4) for _ in range(2)]
    std = [torch.rand(2, 4) + 0.5 for _ in range(2)]
    perm, sign = torch.tensor([1, 0, 3, 2]), torch.ones(4)
    rows = {
        "action": lambda p: losses.action_loss(p, policy[1], MASK, LIVE),
        "embedding": lambda p: losses.embedding_loss(p, policy[1]),
        "estimation": lambda p: losses.estimation_loss(p, policy[1]),
        "mirror": lambda p: losses.mirror_loss(policy[1], p, perm, sign, MASK, LIVE),
        "kickstarting": lambda p: kl_divergence(policy[1], std[1], p, std[0]),
    }
    other = policy[0].clone()
    other[1] += 1.0
    for name, loss in rows.items():
        before, after = loss(policy[0]), loss(other)
        assert before.shape == (2,), name
        assert (before != after).tolist() == [False, True], f"{name}: shares of a minibatch would not add up"


def test_an_action_off_by_the_specialists_noise_is_off_by_one():
    std = torch.tensor([[0.05, 0.4, 0.0, 0.0], [0.1, 0.1, 0.2, 0.3]])  # zero in absent slots, as its label is
    units = losses.in_noise_units(std, std, MASK)
    assert torch.allclose(units, MASK), f"expected 1 in live slots and 0 in absent ones, got {units}"


def test_embedding_loss_is_a_mean_over_rows_and_dimensions():
    assert losses.embedding_loss(torch.full((3, 8), 2.0), torch.full((3, 8), 0.5)).mean().item() == pytest.approx(2.25)


def test_estimation_loss_weighs_velocity_and_embodiment_by_their_own_means():
    error = torch.cat([torch.full((4, 3), 2.0), torch.full((4, 30), 3.0)], dim=1)
    target = torch.randn(4, 33)
    assert losses.estimation_loss(target + error, target).mean().item() == pytest.approx(4 + 9, rel=1e-5)


@pytest.mark.parametrize("column", range(33))
def test_every_column_of_the_estimate_counts_once(column):
    error = torch.zeros(4, 33)
    error[:, column] = 3.0
    dims = 3 if column < 3 else 30
    assert losses.estimation_loss(error, torch.zeros(4, 33)).mean().item() == pytest.approx(9 / dims)


def test_estimation_loss_without_embodiment_is_that_of_the_velocity():
    assert losses.estimation_loss(torch.ones(4, 3), torch.zeros(4, 3)).mean().item() == pytest.approx(1.0)


def test_mirror_loss_is_zero_where_the_policy_commutes_with_the_mirror_and_only_there():
    perm, sign = torch.tensor([1, 0, 3, 2]), torch.tensor([1.0, 1.0, -1.0, -1.0])
    mean = torch.randn(2, 4)
    mirrored = mean[:, perm] * sign
    assert losses.mirror_loss(mean, mirrored, perm, sign, MASK, LIVE).mean().item() == 0.0
    off = losses.mirror_loss(mean, mirrored + 0.5, perm, sign, MASK, LIVE).mean().item()
    assert off == pytest.approx(0.25, rel=1e-5)


def test_mirror_loss_moves_only_the_mirrored_pass():
    mean, mirrored = torch.randn(2, 4, requires_grad=True), torch.randn(2, 4, requires_grad=True)
    losses.mirror_loss(mean, mirrored, torch.tensor([1, 0, 3, 2]), torch.ones(4), MASK, LIVE).sum().backward()
    assert mean.grad is None
    assert mirrored.grad.abs().sum() > 0
