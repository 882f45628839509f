from __future__ import annotations

import pytest
import torch

from eagle_rl.models import precision


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
    monkeypatch.setattr(torch.Tensor, "__matmul__", rounded)
    precision.set_up_torch(1)
    assert torch.backends.mkldnn.matmul.fp32_precision == "ieee"
