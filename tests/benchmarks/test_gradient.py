"""The noise of a gradient, from gradients of batches."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from benchmarks.gradient import collect, gradients, noise_scale
from benchmarks.workloads import experiment, make_env, make_runner


def test_the_noise_scale_is_the_variance_of_a_sample_over_the_square_of_the_mean():
    """Batches of 25 samples of variance 9 in each of 1000 directions about a mean of length 5: 9000 / 25."""
    generator = torch.Generator().manual_seed(0)
    mean = torch.zeros(1000)
    mean[0] = 5.0
    found = [mean + 3.0 / 25**0.5 * torch.randn(1000, generator=generator) for _ in range(400)]
    scatter, square, samples = noise_scale(found, 25)
    assert scatter == pytest.approx(9000.0, rel=0.05)
    assert square == pytest.approx(25.0, rel=0.1)
    assert samples == pytest.approx(360.0, rel=0.12)


def test_a_mean_lost_in_noise_has_no_scale():
    assert noise_scale([torch.tensor([1.0]), torch.tensor([-1.0])], 10)[2] == float("inf")


def test_a_shorter_trace_gives_other_gradients_of_the_same_batches():
    cfg = replace(experiment(1), robots=("h1", "t1"))
    runner = make_runner(cfg, make_env(cfg, 8, compiled=False))
    collect(runner)
    found = gradients(runner, (0.95, 0.5), 2)
    assert [len(grads) for grads in found.values()] == [2, 2], "one for every two environments of each robot"
    for long, short in zip(found[0.95], found[0.5], strict=True):
        assert torch.isfinite(long).all()
        assert not torch.allclose(long, short)
    assert runner.alg.storage.step == 0, "the rollout is used up"
