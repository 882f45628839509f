from __future__ import annotations

import sys

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


@pytest.fixture(scope="module")
def layered():
    """A compiled kernel with a constant, as TorchInductor hands it out, and what it was made for."""
    scale, inputs = torch.tensor([2.0, 3.0, 4.0]), [torch.ones(5, 3), torch.arange(3.0)]
    graph = kernels.record(lambda x, y: [x * scale + y, (x - y).sum(dim=1)], inputs)
    kept = kernels._without_layers
    try:
        kernels._without_layers = lambda kernel, inputs: kernel
        return kernels.compile_graph(graph, inputs), inputs
    finally:
        kernels._without_layers = kept


def test_a_kernel_is_called_without_what_torch_puts_before_it(layered, monkeypatch):
    from torch._inductor.output_code import CompiledFxGraph

    kernel, inputs = layered
    bare = kernels._without_layers(kernel, inputs)

    def refuse(*_: object) -> None:
        raise AssertionError("torch's layers are still there")

    monkeypatch.setattr(CompiledFxGraph, "__call__", refuse)
    for x in (inputs[0], 7 * inputs[0]):
        total, difference = bare(x, inputs[1])
        assert torch.equal(total, x * torch.tensor([2.0, 3.0, 4.0]) + inputs[1]), "constants or inputs are mixed up"
        assert torch.equal(difference, (x - inputs[1]).sum(dim=1))
    with pytest.raises(AssertionError, match="still there"):
        kernel(*inputs)


def test_layers_that_do_something_are_kept(layered):
    kernel, inputs = layered
    for changed in (
        lambda *x: [y.clone() for y in kernel(*x)],
        lambda *x: kernel(*x)[:1],
        lambda *x: kernel(x[0].clone(), x[1]),
        lambda *x: [*kernel(*x), *kernel(*x)],
        lambda *x: [y + 1.0 for y in x],
    ):
        assert kernels._without_layers(changed, inputs) is changed, "what it does besides calling the kernel is lost"


def test_where_torch_has_no_such_layers_a_kernel_is_as_it_was(layered, monkeypatch):
    kernel, inputs = layered
    monkeypatch.setitem(sys.modules, "torch._inductor.output_code", None)
    assert kernels._without_layers(kernel, inputs) is kernel
