"""What corrections and foresight are linear in: waves of the gait, monomials of the command, and their products."""

from __future__ import annotations

import math
from itertools import combinations_with_replacement

import torch
from torch import Tensor

DEGREE = 3
"""Of the polynomials of the command."""


def waves(phase: Tensor, num_harmonics: int) -> Tensor:
    """1, cos 2 pi phi, sin 2 pi phi, cos 4 pi phi, ... of phases (...) [cycles], shape (..., 2 num_harmonics + 1)."""
    angle = 2.0 * math.pi * phase.unsqueeze(-1) * torch.arange(1, num_harmonics + 1, device=phase.device)
    both = torch.stack((torch.cos(angle), torch.sin(angle)), dim=-1).flatten(-2)
    return torch.cat((torch.ones_like(phase).unsqueeze(-1), both), dim=-1)


def half_a_cycle(num_harmonics: int) -> Tensor:
    """What half a cycle does to the coefficients of :func:`waves`, shape (2 num_harmonics + 1,)."""
    return (-1.0) ** torch.tensor([0, *(k for k in range(1, num_harmonics + 1) for _ in range(2))])


def monomials(x: Tensor) -> Tensor:
    """Products of up to ``DEGREE`` numbers of ``x`` (N, 5): 1, the numbers, and so on; shape (N, 56)."""
    with_one = torch.cat((torch.ones_like(x[:, :1]), x), dim=1)
    factors = list(combinations_with_replacement(range(with_one.shape[1]), DEGREE))
    return with_one[:, factors].prod(dim=2)


def products(a: Tensor, b: Tensor) -> Tensor:
    """All products of a number of ``a`` (..., A) and one of ``b`` (..., B), shape (..., A B)."""
    return (a.unsqueeze(-1) * b.unsqueeze(-2)).flatten(-2)
