"""How torch multiplies matrices in this process; learning on a CPU is little else."""

from __future__ import annotations

from typing import Any

import torch


def set_up_torch(num_threads: int) -> None:
    """Compute with so many threads, and multiply float32 matrices by oneDNN wherever that is exact.

    torch's default, MKL, leaves AVX-512 unused on AMD's processors, where oneDNN is more than twice as fast. torch
    takes oneDNN only if bfloat16 is allowed inside a product. Processors without AMX make no use of that permission; it
    is withdrawn where a product shows that this one does.
    """
    torch.set_num_threads(num_threads)
    matmul: Any = getattr(torch.backends.mkldnn, "matmul", None)
    if hasattr(matmul, "fp32_precision"):  # torch 2.9 and later
        matmul.fp32_precision = "bf16"
        if not _products_are_float32():
            matmul.fp32_precision = "ieee"


def _products_are_float32() -> bool:
    """Whether a product keeps a digit that float32 has and bfloat16 has not."""
    fine = torch.full((64, 64), 1.0 + 2.0**-12)
    return torch.equal(fine @ torch.ones(64, 64), 64.0 * fine)
