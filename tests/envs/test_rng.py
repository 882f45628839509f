from __future__ import annotations

import math

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from envs.rng import CounterRng


def pool(seed: int, **counts: int) -> CounterRng:
    names = [name for name, count in counts.items() for _ in range(count)]
    return CounterRng(seed, names, torch.cat([torch.arange(count) for count in counts.values()]))


def draws(rng: CounterRng, stream: str, count: int, size: int, ids: Tensor | None = None) -> Tensor:
    rows = len(rng.key) if ids is None else len(ids)
    return rng.uniform(stream, torch.full((rows,), count), size, ids)


@given(st.integers(0, 2**31), st.integers(0, 10**9), st.integers(1, 40), st.integers(0, 5))
def test_numbers_do_not_depend_on_who_else_draws(seed: int, count: int, size: int, others: int) -> None:
    alone = draws(pool(seed, g1=3), "x", count, size)
    pooled = draws(pool(seed, h1=others, g1=3 + others, t1=2), "x", count, size)
    assert torch.equal(alone, pooled[others : others + 3])


def test_drawing_for_some_environments_gives_the_numbers_of_drawing_for_all() -> None:
    rng = pool(5, h1=4, g1=4)
    ids = torch.tensor([1, 6])
    assert torch.equal(draws(rng, "x", 7, 9, ids), draws(rng, "x", 7, 9)[ids])


def test_longer_draws_begin_with_the_shorter_ones() -> None:
    rng = pool(5, h1=4)
    assert torch.equal(draws(rng, "x", 7, 32)[:, :9], draws(rng, "x", 7, 9))


def test_a_draw_leaves_nothing_behind() -> None:
    rng = pool(5, h1=4)
    first = draws(rng, "x", 0, 3)
    draws(rng, "y", 1, 30)
    assert torch.equal(draws(rng, "x", 0, 3), first)


def test_every_coordinate_changes_the_numbers() -> None:
    first = draws(pool(0, h1=8), "x", 0, 50)
    others = {
        "seed": draws(pool(1, h1=8), "x", 0, 50),
        "robot": draws(pool(0, g1=8), "x", 0, 50),
        "stream": draws(pool(0, h1=8), "y", 0, 50),
        "count": draws(pool(0, h1=8), "x", 1, 50),
        "environment": draws(pool(0, h1=8), "x", 0, 50).roll(1, dims=0),
        "column": draws(pool(0, h1=8), "x", 0, 51)[:, 1:],
    }
    for coordinate, other in others.items():
        assert (first == other).double().mean() < 0.01, f"{coordinate} does not change the draw"
        correlation = torch.corrcoef(torch.stack([first.flatten(), other.flatten()]).double())[0, 1]
        assert abs(correlation) < 5.0 / math.sqrt(first.numel()), f"draws along {coordinate} are correlated"


def test_numbers_are_uniform_in_the_half_open_interval() -> None:
    x = draws(pool(11, h1=2000), "x", 3, 64).double()
    n = x.numel()
    assert x.min() >= 0.0
    assert x.max() < 1.0
    counts = torch.histc(x, bins=64, min=0.0, max=1.0)
    chi_square = ((counts - n / 64).square() / (n / 64)).sum()
    assert chi_square < 63 + 5 * math.sqrt(2 * 63)
    assert abs(x.mean() - 0.5) < 5.0 / math.sqrt(12 * n)


def test_neighbouring_environments_and_counts_are_uncorrelated() -> None:
    rng = pool(0, h1=500)
    x = torch.cat([draws(rng, "x", count, 1) for count in range(200)], dim=1).double() - 0.5
    for name, product in {"environments": x[1:] * x[:-1], "counts": x[:, 1:] * x[:, :-1]}.items():
        assert abs(product.mean()) * 12.0 < 5.0 / math.sqrt(product.numel()), f"neighbouring {name} are correlated"


def test_bounds_may_differ_between_environments() -> None:
    rng, zeros = pool(0, h1=1000), torch.zeros(1000, dtype=torch.long)
    low = torch.linspace(-1.0, 1.0, 1000).unsqueeze(1)
    x = rng.uniform_in(low, low + 0.5, "x", zeros, 3)
    assert (x >= low).all()
    assert (x <= low + 0.5).all()
