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

    ``auto`` does so on CPUs where that is quicker. It asks the processor instead of a clock, so that a resumed run
    computes what the interrupted one would have.
    """
    if precision != "auto":
        return precision == "bfloat16"
    return torch.device(device).type == "cpu" and _is_quick_in_bfloat16(_capabilities())


def _is_quick_in_bfloat16(capabilities: dict[str, Any]) -> bool:
    """Whether a processor multiplies more bfloat16 numbers than float32 numbers in the same time.

    Intel's do so by AMX alone: by AVX-512 they take twice as long as in float32, where AMD's take half as long.
    """
    by_avx512 = bool(capabilities.get("avx512_bf16")) and not _is_intels(capabilities)
    return by_avx512 or bool(capabilities.get("amx_bf16"))


def _capabilities() -> dict[str, Any]:
    """What torch knows of the processor; nothing before torch 2.10."""
    return getattr(torch.cpu, "get_capabilities", dict)()


def _is_intels(capabilities: dict[str, Any]) -> bool:
    """Whether the processor is of the maker of MKL."""
    return "Intel" in str(capabilities.get("cpu_name"))


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
    """Learn with so many threads, and multiply float32 matrices by whichever library is quickest here and exact.

    Each computes with one thread of torch's, and so does all that is not shared out (:mod:`eagle_rl.threads`).

    torch's default, MKL, is the quickest on Intel's processors. On others it leaves AVX-512 unused, where oneDNN is
    more than twice as fast. torch takes oneDNN only if bfloat16 is allowed inside a product. Processors without AMX
    make no use of that permission; it is withdrawn where a product shows that this one does.
    """
    torch.set_num_threads(1)
    use_threads(num_threads)
    matmul: Any = getattr(torch.backends.mkldnn, "matmul", None)
    if hasattr(matmul, "fp32_precision"):  # torch 2.9 and later
        matmul.fp32_precision = "ieee" if _is_intels(_capabilities()) else "bf16"
        if not _products_are_float32():
            matmul.fp32_precision = "ieee"


def _products_are_float32() -> bool:
    """Whether a product keeps a digit that float32 has and bfloat16 has not."""
    fine = torch.full((64, 64), 1.0 + 2.0**-12)
    return torch.equal(fine @ torch.ones(64, 64), 64.0 * fine)
