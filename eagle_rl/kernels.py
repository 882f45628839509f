"""Tensor arithmetic, recorded once and compiled into one kernel by TorchInductor.

A function of tensors is run once on tensors that take notes; the notes are compiled into C++, and from then on the
kernel does what the function did. Nothing is traced by reading Python, so that nothing the function does but tensor
arithmetic may matter: it must not branch on values, count in Python, or draw constants for the first time.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, fx

from eagle_rl.errors import CompileError
from eagle_rl.machine import find_compiler

Kernel = Callable[..., Sequence[Tensor]]
"""Takes tensors of just the shapes, types and strides it was made for."""

_TRUSTING = {"size_asserts": False, "alignment_asserts": False, "assert_indirect_indexing": False}
"""Whoever calls a kernel sees to it that its inputs are as promised; to check them takes a tenth of a small one."""


def record(function: Callable[..., list[Tensor]], inputs: Sequence[Tensor]) -> fx.GraphModule:
    """The operations of a function on these tensors; what is neither among them nor made of them is a constant."""
    from torch.fx.experimental.proxy_tensor import make_fx

    graph: fx.GraphModule = make_fx(function)(*inputs)
    _lighten(graph)
    return graph


def drop_unused(graph: fx.GraphModule) -> list[int]:
    """Take from a graph the inputs that it does not use; returns the indices of the others."""
    places = [node for node in graph.graph.nodes if node.op == "placeholder"]
    used = [i for i, place in enumerate(places) if place.users]
    for place in places:
        if not place.users:
            graph.graph.erase_node(place)
    graph.recompile()
    return used


def _lighten(graph: fx.GraphModule) -> None:
    """Do the same with less, as far as it is in float32; bfloat16 would round differently.

    The derivative of ELU is taken from its result, which saves an exponential. A bias is added by whatever uses the
    product: in the product it would be written to every row beforehand. It is subtracted, because inductor would put
    an addition back into the product.
    """
    aten, nodes = torch.ops.aten, graph.graph
    results: dict[fx.node.Argument, fx.Node] = {}
    for node in list(nodes.nodes):
        if node.op != "call_function" or getattr(node.meta["val"], "dtype", None) != torch.float32:
            continue
        if node.target is aten.elu.default:
            results[node.args[0]] = node
        elif node.target is aten.elu_backward.default and node.args[5] in results:
            node.args = (*node.args[:4], True, results[node.args[5]])
        elif node.target is aten.addmm.default and len(node.args) == 3 and not node.kwargs:
            bias, left, right = node.args
            with nodes.inserting_before(node):
                negative = nodes.call_function(aten.neg.default, (bias,))
                product = nodes.call_function(aten.mm.default, (left, right))
                node.replace_all_uses_with(nodes.call_function(aten.sub.Tensor, (product, negative)))
            nodes.erase_node(node)
    graph.recompile()


def compile_graph(graph: fx.GraphModule, inputs: Sequence[Tensor]) -> Kernel:
    """The graph as one C++ kernel, for inputs of just these shapes and strides.

    Inductor keeps what it compiled on disk, where only a graph of fake tensors is looked up. What calls the parts of
    the kernel is in C++ too, so that several threads may use it at a time.

    Args:
        graph: what :func:`record` returned.
        inputs: tensors like those it will get.

    Raises:
        CompileError: there is no C++ compiler, or it failed.
    """
    find_compiler()
    from torch._guards import TracingContext, tracing
    from torch._subclasses import FakeTensorMode
    from torch.fx.experimental.symbolic_shapes import ShapeEnv

    mode = FakeTensorMode(shape_env=ShapeEnv())
    fakes: list[Any] = [mode.from_tensor(x, static_shapes=True) for x in inputs]
    try:
        # With gradients enabled inductor compiles a graph as half of a training step, which is three times as slow.
        with torch.no_grad(), tracing(TracingContext(mode)), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns of torch
            from torch._inductor import compile as compile_with_inductor

            kernel: Kernel = compile_with_inductor(graph, fakes, options={"cpp_wrapper": True} | _TRUSTING)
    except Exception as error:  # whatever the compiler and those who drive it raise
        raise CompileError(f"The kernel could not be compiled: {error}") from error
    return _without_layers(kernel, inputs)


def _without_layers(kernel: Kernel, inputs: Sequence[Tensor]) -> Kernel:
    """What a kernel calls in the end, where the layers of Python before it add constants and nothing else.

    They are for gradients and for inputs that are written to, which there are not; to pass them takes a fiftieth of a
    control step of 64 environments.
    """
    try:
        from torch._inductor.output_code import CompiledFxGraph
    except ImportError:  # it is torch's own affair, and other versions may have it elsewhere
        return kernel
    calls: list[tuple[CompiledFxGraph, list[Tensor], Sequence[Tensor]]] = []
    call = CompiledFxGraph.__call__

    def listen(compiled: CompiledFxGraph, given: Sequence[Tensor]) -> Sequence[Tensor]:
        passed = list(given)  # the call empties it
        results = call(compiled, given)
        calls.append((compiled, passed, results))
        return results

    with patch.object(CompiledFxGraph, "__call__", listen), torch.no_grad():
        results = kernel(*inputs)
    if len(calls) != 1:
        return kernel
    ((compiled, passed, made),) = calls
    constants = passed[: len(passed) - len(inputs)]
    innermost = getattr(compiled, "current_callable", None)
    if innermost is None or not _same([*constants, *inputs], passed) or not _same(results, made):
        return kernel
    return lambda *tensors: innermost([*constants, *tensors])


def _same(some: Sequence[Tensor], others: Sequence[Tensor]) -> bool:
    """Whether these are the very same tensors, in the same order."""
    return len(some) == len(others) and all(a is b for a, b in zip(some, others, strict=True))
