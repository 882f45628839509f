"""Absent slots take no part in the action distribution."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Normal, kl_divergence

from eagle_rl.models import MaskedGaussian
from envs.robots.slots import NUM_SLOTS
from tests.learner.helpers import make_runner, parameters
from tests.toy import ToyEnv


def random_distribution(seed: int, rows: int = 5) -> MaskedGaussian:
    generator = torch.Generator().manual_seed(seed)
    distribution = MaskedGaussian(NUM_SLOTS, 0.7, (0.1, 1.2)).double()
    with torch.no_grad():
        distribution.std_param.uniform_(0.1, 1.2, generator=generator)
    distribution.mask = (torch.rand(rows, NUM_SLOTS, generator=generator) > 0.4).double()
    distribution.mask[:, 0] = 1.0
    distribution.update(torch.randn(rows, NUM_SLOTS, generator=generator, dtype=torch.float64))
    return distribution


def live(values: torch.Tensor, mask: torch.Tensor) -> list[torch.Tensor]:
    return [row[live_slots > 0] for row, live_slots in zip(values, mask, strict=True)]


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31))
def test_log_prob_and_entropy_are_those_of_a_normal_over_the_live_slots(seed):
    distribution = random_distribution(seed)
    actions = distribution.sample()
    mask = distribution.mask
    dense = [Normal(m, s) for m, s in zip(live(distribution.mean, mask), live(distribution.std, mask), strict=True)]
    log_prob = [normal.log_prob(a).sum() for normal, a in zip(dense, live(actions, mask), strict=True)]
    torch.testing.assert_close(distribution.log_prob(actions), torch.stack(log_prob))
    torch.testing.assert_close(distribution.entropy, torch.stack([normal.entropy().sum() for normal in dense]))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31))
def test_absent_slots_sample_exactly_zero_and_live_slots_never_do(seed):
    distribution = random_distribution(seed)
    assert torch.equal(distribution.sample() != 0, distribution.mask > 0)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31))
def test_kl_is_zero_on_itself_and_that_of_normals_over_live_slots_otherwise(seed):
    old = random_distribution(seed)
    new = random_distribution(seed + 1)
    new.mask = old.mask
    new.update(torch.randn(len(old.mask), NUM_SLOTS, dtype=torch.float64))
    assert torch.equal(old.kl_divergence(old.params, old.params), torch.zeros(len(old.mask), dtype=torch.float64))
    pairs = [live(x, old.mask) for x in (old.mean, old.std, new.mean, new.std)]
    dense = [kl_divergence(Normal(m0, s0), Normal(m1, s1)).sum() for m0, s0, m1, s1 in zip(*pairs, strict=True)]
    torch.testing.assert_close(old.kl_divergence(old.params, new.params), torch.stack(dense))


def test_std_beyond_its_range_is_put_back_to_where_it_has_a_gradient():
    distribution = MaskedGaussian(NUM_SLOTS, 5.0, (0.1, 1.2))
    distribution.project_std()
    distribution.mask = torch.ones(1, NUM_SLOTS)
    distribution.update(torch.zeros(1, NUM_SLOTS))
    distribution.entropy.sum().backward()
    assert torch.equal(distribution.std_param.detach(), torch.full((NUM_SLOTS,), 1.2))
    assert (distribution.std_param.grad > 0).all()


@pytest.mark.parametrize("perturbation", [1.0, 1e6])
def test_weights_of_slots_no_robot_has_change_nothing(perturbation):
    robots = ("one", "two")
    absent = torch.arange(NUM_SLOTS) >= 15
    plain, perturbed = make_runner(env=ToyEnv(robots=robots)), make_runner(env=ToyEnv(robots=robots))
    head = perturbed.alg.actor.mlp[-1]
    with torch.no_grad():
        head.weight[absent] += perturbation
        head.bias[absent] -= perturbation
        perturbed.alg.actor.distribution.std_param[absent] = 0.11
    before = {key: x[absent] for key, x in parameters(perturbed).items() if len(x) == NUM_SLOTS and "actor" in key}
    for runner in (plain, perturbed):
        torch.manual_seed(7)
        runner.learn(2)
    after = parameters(perturbed)
    for key, expected in parameters(plain).items():
        slots = ~absent if key in ("actor.mlp.4.weight", "actor.mlp.4.bias", "actor.distribution.std_param") else ...
        assert torch.equal(after[key][slots], expected[slots]), f"{key} feels the weights of absent slots"
    for key in ("actor.mlp.4.weight", "actor.mlp.4.bias", "actor.distribution.std_param"):
        assert torch.equal(after[key][absent], before[key]), f"{key} of absent slots was trained"
