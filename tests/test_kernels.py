from __future__ import annotations

import pytest
import torch
from torch.nn.functional import elu, linear

from eagle_rl import kernels


def derivatives(weight: torch.Tensor, bias: torch.Tensor, rows: torch.Tensor) -> list[torch.Tensor]:
    """Of a layer with ELU, by weight and bias."""
    with torch.enable_grad():
        asked = [x.detach().requires_grad_() for x in (weight, bias)]
        return list(torch.autograd.grad(elu(linear(rows, *asked)).square().sum(), asked))


def a_layer(dtype: torch.dtype) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(shape, generator=generator).to(dtype) for shape in ((5, 3), (5,), (40, 3))]


def targets(graph: torch.fx.GraphModule) -> set[object]:
    return {node.target for node in graph.graph.nodes}


def test_a_recorded_layer_adds_its_bias_later_and_derives_from_its_result():
    inputs = a_layer(torch.float32)
    graph = kernels.record(lambda *x: derivatives(*x), inputs)
    assert torch.ops.aten.addmm.default not in targets(graph), "the bias is written to every row before the product"
    (backward,) = (node for node in graph.graph.nodes if node.target is torch.ops.aten.elu_backward.default)
    assert backward.args[4] is True, "the derivative of ELU costs another exponential"
    for found, expected in zip(graph(*inputs), derivatives(*inputs), strict=True):
        torch.testing.assert_close(found, expected, msg="a lighter graph computes something else")


def test_a_recorded_layer_in_bfloat16_is_left_alone():
    inputs = a_layer(torch.bfloat16)
    graph = kernels.record(lambda *x: derivatives(*x), inputs)
    assert torch.ops.aten.addmm.default in targets(graph)
    for found, expected in zip(graph(*inputs), derivatives(*inputs), strict=True):
        assert torch.equal(found, expected), "bfloat16 is rounded elsewhere than in the code"


@pytest.mark.parametrize("alpha", [1.0, 0.5])
def test_the_derivative_from_the_result_is_right_for_every_slope(alpha):
    def slope(x: torch.Tensor) -> list[torch.Tensor]:
        with torch.enable_grad():
            at = x.detach().requires_grad_()
            return list(torch.autograd.grad(elu(at, alpha).sum(), [at]))

    x = torch.tensor([-3.0, -0.5, 0.0, 2.0])
    (found,) = kernels.record(slope, [x])(x)
    expected = torch.where(x > 0, torch.ones(4), alpha * torch.exp(x))
    torch.testing.assert_close(found, expected)


def test_kernels_are_called_without_python(monkeypatch):
    """Threads compute side by side only if a call leaves the interpreter's lock alone, which C++ wrappers do."""
    import torch._inductor as inductor

    asked = {}
    monkeypatch.setattr(inductor, "compile", lambda graph, fakes, options: asked.update(options) or graph)
    inputs = [torch.ones(3)]
    kernels.compile_graph(kernels.record(lambda x: [x + 1], inputs), inputs)
    assert asked["cpp_wrapper"] is True, "a kernel that keeps Python to itself makes the others wait"
