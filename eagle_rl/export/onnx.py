"""Write a policy as one ONNX file with its contract inside, and prove that it computes the same."""

from __future__ import annotations

import copy
import io
import logging
import warnings
from contextlib import redirect_stdout
from pathlib import Path

import onnx
import onnxruntime
import torch
from torch import Tensor

from eagle_rl.errors import CheckpointError
from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ExportedActor
from eagle_rl.runners.files import write_atomically

from .contract import DIGEST_KEY, METADATA_KEY, Contract

TOLERANCE = 1e-5
"""Largest difference allowed between ONNX and torch, as a share of an output's largest value, at least of 1."""
_BATCHES = (1, 64)


def export_onnx(actor: EagleActor, contract: Contract, path: Path) -> float:
    """Write the policy to ``path``; the batch dimension is free.

    Returns:
        The largest difference from torch found in checking it, see TOLERANCE.

    Raises:
        CheckpointError: ONNX computes something else; nothing is written.
    """
    module = ExportedActor(copy.deepcopy(actor)).eval()
    model = onnx.load_from_string(_to_onnx(module))
    for node in model.graph.node:
        node.ClearField("metadata_props")  # the exporter's call stacks, with paths of the machine it ran on
    model.metadata_props.add(key=METADATA_KEY, value=contract.to_json())
    model.metadata_props.add(key=DIGEST_KEY, value=contract.digest)
    data = model.SerializeToString()
    difference = compare(module, data)
    if not difference <= TOLERANCE:
        raise CheckpointError(
            f"{path}: ONNX and torch differ by {difference:.2g}, allowed {TOLERANCE:.0e}; not written."
        )
    write_atomically(path, data)
    return difference


def compare(module: ExportedActor, data: bytes, scale: float = 3.0) -> float:
    """Largest difference of any output between ONNX and torch on random inputs of several batch sizes.

    It is taken relative to the output's size, because single precision is: a trained policy's embedding reaches 90
    on such inputs, and torch itself is then 3e-5 away from the same network in double precision.
    """
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    generator = torch.Generator().manual_seed(0)
    worst = 0.0
    for batch in _BATCHES:
        inputs = [scale * torch.randn(batch, dim, generator=generator) for dim in module.input_dims]
        inputs[-1] = (inputs[-1] > 0).float()
        with torch.inference_mode():
            expected: tuple[Tensor, ...] = module(*inputs)
        found = session.run(
            list(module.output_names), {n: x.numpy() for n, x in zip(module.input_names, inputs, strict=True)}
        )
        worst = max(worst, *(_difference(torch.as_tensor(f), e) for f, e in zip(found, expected, strict=True)))
    return worst


def _difference(found: Tensor, expected: Tensor) -> float:
    return float((found - expected).abs().max() / expected.abs().max().clamp(min=1.0))


def _to_onnx(module: ExportedActor) -> bytes:
    """The network as ONNX, quietly."""
    inputs = tuple(x.expand(2, -1).contiguous() for x in module.get_dummy_inputs())
    batch = torch.export.Dim("batch")
    for name in ("onnxscript", "torch.onnx._internal.exporter._registration"):
        logging.getLogger(name).setLevel(logging.ERROR)
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            module,
            inputs,
            input_names=list(module.input_names),
            output_names=list(module.output_names),
            dynamic_shapes=tuple({0: batch} for _ in inputs),
            dynamo=True,
            verbose=False,
        )
        assert program is not None
        return program.model_proto.SerializeToString()
