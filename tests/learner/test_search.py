"""The search on a last layer, against costs whose best parameters are known."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from eagle_rl.algorithms.search import FINAL_STEP, LastLayerSearch
from eagle_rl.config.schema import SearchCfg
from tests.learner.helpers import make_runner

CFG = SearchCfg(num_pairs=64, num_directions=3, std=0.02, step=0.5)
SLOTS = torch.tensor([0, 2, 5])
GENERATIONS = 50
EVEN_OR_ODD = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, 1.0])
"""What a mirror does to each of the six axes of the activations."""
PERM, SIGN = torch.arange(32), torch.ones(32)
PERM[[0, 2]], SIGN[[0, 2]] = torch.tensor([2, 0]), -1.0
"""Slots 0 and 2 are a roll joint left and right, slot 5 a pitch joint in the middle."""


@pytest.fixture
def hidden() -> Tensor:
    """Activations that move 3, 1, 0.5, ... far along six axes, around 2."""
    spread = torch.diag(torch.tensor([3.0, 1.0, 0.5, 0.1, 0.01, 0.0]))
    return 2.0 + torch.randn(500, 6, generator=torch.Generator().manual_seed(0)) @ spread


def in_a_mirror(hidden: Tensor) -> Tensor:
    return 2.0 + (hidden - 2.0) * EVEN_OR_ODD


def along(hidden: Tensor, mirrored: Tensor | None = None, cfg: SearchCfg = CFG) -> LastLayerSearch:
    mirrored = in_a_mirror(hidden) if mirrored is None else mirrored
    return LastLayerSearch.along(
        cfg, hidden, mirrored, slots=SLOTS, mirror=(PERM, SIGN), num_generations=GENERATIONS, seed=7
    )


@pytest.fixture
def search(hidden) -> LastLayerSearch:
    return along(hidden)


def test_directions_have_unit_variance_and_do_not_correlate(search, hidden):
    inputs = (torch.cat((hidden, in_a_mirror(hidden))) - search.mean) @ search.directions.T
    torch.testing.assert_close(inputs.T @ inputs / len(inputs), torch.eye(3), atol=1e-4, rtol=0)


def test_directions_that_hardly_move_are_left_out(hidden):
    search = along(hidden, cfg=SearchCfg(num_directions=64))
    assert len(search.directions) == 4, "the last two move less than a hundredth as far as the first"


def test_directions_without_a_mirror_image_are_left_out(hidden):
    mirrored = in_a_mirror(hidden)
    mirrored[:, 0] = mirrored[torch.randperm(500, generator=torch.Generator().manual_seed(1)), 0]
    assert len(along(hidden, mirrored).directions) == 2, "the first axis of the mirror image moves by itself"


def test_what_is_tried_treats_left_and_right_alike(search, hidden):
    parameters = search.pairs()[0][:1].expand(len(hidden), -1, -1)
    nothing = torch.zeros(len(hidden), 32)
    change, image = (search.change(parameters, x, nothing) for x in (hidden, in_a_mirror(hidden)))
    assert change[:, SLOTS].abs().mean() > 0.1 * CFG.std
    torch.testing.assert_close(image, change[:, PERM] * SIGN, atol=1e-4, rtol=0)


def test_pairs_lie_opposite_each_other_and_change_with_the_generation(search):
    search.parameters = torch.ones_like(search.parameters)
    first, second = search.pairs()
    torch.testing.assert_close((first + second) / 2, torch.ones_like(first))
    moved = (first - 1)[:, (first != 1).any(dim=0)]
    assert moved.std().item() == pytest.approx(CFG.std, rel=0.1)
    assert torch.equal(search.pairs()[0], first), "the same until a step is taken"
    search.learn(torch.ones(CFG.num_pairs))
    assert not torch.equal(search.pairs()[0] - search.parameters, first - 1), "every generation has its own"


def test_a_search_comes_near_the_best_parameters(search):
    best = torch.randn(search.parameters.shape, generator=torch.Generator().manual_seed(1)) * 0.1
    best = 0.5 * (best + search.sign * best[search.partner])

    def cost(parameters: Tensor) -> Tensor:
        return (parameters - best).square().sum(dim=(1, 2))

    start = cost(search.parameters[None])
    while search.generation < GENERATIONS:
        first, second = search.pairs()
        search.learn(cost(second) - cost(first))
    assert cost(search.parameters[None]) < 0.1 * start


def test_steps_shrink_on_a_line_to_a_fifth(search):
    lengths = []
    while search.generation < GENERATIONS:
        before = search.parameters
        search.learn(torch.ones(CFG.num_pairs))
        lengths.append((search.parameters - before).norm().item())
    first = CFG.step * CFG.std * math.sqrt(search.parameters.numel())
    last = first * (FINAL_STEP + (1 - FINAL_STEP) / GENERATIONS)
    assert (lengths[0], lengths[-1]) == pytest.approx((first, last), rel=1e-4)
    assert lengths[GENERATIONS // 2] == pytest.approx(first * (1 + FINAL_STEP) / 2, rel=1e-4)


def test_one_fall_does_not_decide_a_step(hidden):
    better = torch.ones(CFG.num_pairs)
    moderate, absurd = better.clone(), better.clone()
    moderate[0], absurd[0] = 3.0, 1e6
    steps = []
    for differences in (moderate, absurd):
        search = along(hidden)
        search.learn(differences)
        steps.append(search.parameters)
    assert torch.equal(*steps), "beyond three medians all differences are the same"


def test_pairs_that_make_no_difference_move_nothing(search):
    search.learn(torch.zeros(CFG.num_pairs))
    assert not search.parameters.any()
    assert torch.isfinite(search.momentum).all()


def test_what_was_found_is_in_the_weights():
    runner = make_runner()
    actor, obs = runner.alg.actor, runner.env.get_observations()
    hidden = actor.hidden(obs).detach()
    search = along(hidden, mirrored=hidden)
    search.parameters = torch.randn(search.parameters.shape, generator=torch.Generator().manual_seed(1))
    everywhere = search.parameters.expand(len(obs), -1, -1)
    before = actor(obs).detach()
    expected = search.change(everywhere, hidden, actor.mlp[-1](hidden)) * obs["slot_mask"]
    search.fold_into(actor)
    torch.testing.assert_close(actor(obs), expected, atol=1e-4, rtol=1e-4)
    changed = ((actor(obs) - before).abs() > 1e-3).any(dim=0).nonzero().flatten()
    assert changed.tolist() == SLOTS.tolist(), "the other joints act as before"


def test_a_stored_search_goes_on_as_if_it_had_not_been(search):
    search.learn(torch.arange(CFG.num_pairs).float())
    twin = LastLayerSearch(CFG, **search.state_dict())
    for either in (search, twin):
        either.learn(torch.arange(CFG.num_pairs).float().flip(0))
    assert torch.equal(search.parameters, twin.parameters)
    assert search.generation == twin.generation == 2
