from __future__ import annotations

import pytest
import torch

from eagle_rl.algorithms.terms import Policy
from eagle_rl.models import precision
from eagle_rl.models.distribution import log_prob
from eagle_rl.runners.on_policy import EagleRunner
from tests.learner.helpers import collect, make_runner


@pytest.mark.parametrize("shape", [(1920, 510, 256), (64, 174, 256), (1, 33, 64)])
def test_products_are_as_exact_as_float32(shape):
    precision.set_up_torch(1)
    rows, inner, columns = shape
    generator = torch.Generator().manual_seed(0)
    a = torch.randn(rows, inner, generator=generator)
    b = torch.randn(inner, columns, generator=generator)
    bound = inner * torch.finfo(torch.float32).eps * (a.double().abs() @ b.double().abs())
    assert ((a @ b).double() - a.double() @ b.double()).abs().le(bound).all(), "products lost digits of float32"


def test_a_processor_that_rounds_to_bfloat16_is_found_out(monkeypatch):
    """The product of the check, as a unit for bfloat16 computes it, fails the check and withdraws the permission."""
    product = torch.Tensor.__matmul__
    rounded = lambda a, b: product(a.bfloat16().float(), b.bfloat16().float())  # noqa: E731
    on_a(monkeypatch, ZEN)
    monkeypatch.setattr(torch.Tensor, "__matmul__", rounded)
    precision.set_up_torch(1)
    assert torch.backends.mkldnn.matmul.fp32_precision == "ieee"


ZEN = {"cpu_name": "AMD EPYC", "avx512_bf16": True, "amx_bf16": False}
ZEN_WITHOUT = {"cpu_name": "AMD EPYC", "avx512_bf16": False, "amx_bf16": False}
XEON = {"cpu_name": "Intel Xeon", "avx512_bf16": True, "amx_bf16": True}
XEON_WITHOUT_AMX = {"cpu_name": "Intel Xeon", "avx512_bf16": True, "amx_bf16": False}


def on_a(monkeypatch, processor):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: processor, raising=False)


@pytest.mark.parametrize(
    ("processor", "quick"), [(ZEN, True), (ZEN_WITHOUT, False), (XEON, True), (XEON_WITHOUT_AMX, False), ({}, False)]
)
def test_auto_is_bfloat16_where_that_is_quicker(monkeypatch, processor, quick):
    on_a(monkeypatch, processor)
    assert precision.multiplies_in_bfloat16("auto", "cpu") is quick
    assert not precision.multiplies_in_bfloat16("auto", "cuda:0")
    assert precision.multiplies_in_bfloat16("bfloat16", "cuda:0")
    assert not precision.multiplies_in_bfloat16("float32", "cpu")


@pytest.mark.parametrize(("processor", "library"), [(ZEN, "bf16"), (XEON, "ieee"), (XEON_WITHOUT_AMX, "ieee")])
def test_mkl_multiplies_on_the_processors_of_its_maker_and_onednn_on_others(monkeypatch, processor, library):
    on_a(monkeypatch, processor)
    monkeypatch.setattr(precision, "_products_are_float32", lambda: True)
    precision.set_up_torch(1)
    assert torch.backends.mkldnn.matmul.fp32_precision == library, "see set_up_torch for which of them is quickest"


def gradient(runner: EagleRunner) -> torch.Tensor:
    """What one update of the whole rollout leaves in the parameters."""
    runner.alg.update()
    models = (runner.alg.actor, runner.alg.critic)
    return torch.cat([p.grad.flatten() for model in models for p in model.parameters()])


def test_bfloat16_changes_the_gradient_by_its_rounding_and_no_more():
    one_step = {"num_learning_epochs": 1, "num_mini_batches": 1, "learning_rate": 0.0, "max_grad_norm": 1e9}
    exact, rounded = (make_runner(precision=name, **one_step) for name in ("float32", "bfloat16"))
    for runner in (exact, rounded):
        collect(runner)
    rounded.alg.storage = exact.alg.storage
    storage = {key: x.clone() for key, x in vars(exact.alg.storage).items() if isinstance(x, torch.Tensor)}
    expected = gradient(exact)
    vars(exact.alg.storage).update(storage)
    found = gradient(rounded)
    error = (found - expected).norm() / expected.norm()
    assert 0 < error < 0.05, "relative error of the gradient; zero means that nothing was rounded"


def test_importance_ratios_start_at_one_and_outputs_are_float32():
    """What acted and what learns round alike: a difference would look like a policy that has moved."""
    runner = make_runner(precision="bfloat16")
    collect(runner)
    alg = runner.alg
    (share,) = next(alg.storage.minibatches(4, 1))
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        policy, values = Policy.of(alg.actor, share), alg.critic(share)
        new = log_prob(share["actions"], policy.mean, policy.std, share["slot_mask"])
    assert (new - share["old_log_prob"]).abs().max() < 0.01
    for output in (policy.mean, policy.embedding, policy.estimate, values):
        assert output.dtype == torch.float32
