"""How torch multiplies matrices in this process; learning on a CPU is little else."""

from __future__ import annotations

from typing import Any, Literal

import torch
from rsl_rl.modules import MLP
from torch import Tensor, nn

from eagle_rl.threads import use_threads

Precision = Literal["auto", "float32", "bfloat16"]


def multiplies_in_bfloat16(precision: Precision, device: torch.device | str) -> bool:
    """Whether the hidden layers of acting and learning are to multiply in bfloat16.

    ``auto`` does so on CPUs with instructions for it, which take half the time. It asks the processor instead of a
    clock, so that a resumed run computes what the interrupted one would have.
    """
    if precision != "auto":
        return precision == "bfloat16"
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()  # torch 2.10 and later
    return torch.device(device).type == "cpu" and bool(capabilities.get("avx512_bf16"))


class OutputLayer(nn.Linear):
    """A linear layer that computes in the precision of its parameters, under autocast too."""

    def __init__(self, layer: nn.Linear) -> None:
        """Take over the parameters of ``layer``."""
        super().__init__(layer.in_features, layer.out_features, device="meta")
        self.weight, self.bias = layer.weight, layer.bias

    def forward(self, input: Tensor) -> Tensor:
        """Outputs, shape (N, out_features)."""
        with torch.autocast(input.device.type, enabled=False):
            return super().forward(input.to(self.weight.dtype))


def keep_outputs_exact(model: nn.Module) -> None:
    """Let autocast change only the hidden layers of a model's networks, not what leaves them."""
    for network in list(model.modules()):
        if isinstance(network, MLP):
            network[-1] = OutputLayer(network[-1])


def set_up_torch(num_threads: int) -> None:
    """Learn with so many threads, and multiply float32 matrices by oneDNN wherever that is exact.

    Each computes with one thread of torch's, and so does all that is not shared out (:mod:`eagle_rl.threads`).

    torch's default, MKL, leaves AVX-512 unused on AMD's processors, where oneDNN is more than twice as fast. torch
    takes oneDNN only if bfloat16 is allowed inside a product. Processors without AMX make no use of that permission; it
    is withdrawn where a product shows that this one does.
    """
    torch.set_num_threads(1)
    use_threads(num_threads)
    matmul: Any = getattr(torch.backends.mkldnn, "matmul", None)
    if hasattr(matmul, "fp32_precision"):  # torch 2.9 and later
        matmul.fp32_precision = "bf16"
        if not _products_are_float32():
            matmul.fp32_precision = "ieee"


def _products_are_float32() -> bool:
    """Whether a product keeps a digit that float32 has and bfloat16 has not."""
    fine = torch.full((64, 64), 1.0 + 2.0**-12)
    return torch.equal(fine @ torch.ones(64, 64), 64.0 * fine)
