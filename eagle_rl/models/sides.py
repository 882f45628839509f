"""Left and right exchanged in what a policy sees and does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

MirrorMap = Mapping[str, tuple[Tensor, Tensor]]
"""Permutation and sign of each observation group and of ``actions``: mirrored = x[:, perm] * sign."""


def partners(slots: Tensor, perm: Tensor) -> Tensor:
    """Index in ``slots`` (S,) of the same joint on the other side, of which a mirror's permutation says the slot."""
    return (perm[slots].unsqueeze(1) == slots).int().argmax(dim=1)


class Sides(nn.Module):
    """Mirrors groups of columns; moves with a model and is no part of its weights."""

    def __init__(self, mirror: MirrorMap) -> None:
        """Know the groups of ``mirror``."""
        super().__init__()
        self.groups = tuple(mirror)
        for group, (perm, sign) in mirror.items():
            self.register_buffer(f"{group}_perm", perm, persistent=False)
            self.register_buffer(f"{group}_sign", sign, persistent=False)

    def mirrored(self, group: str, x: Tensor) -> Tensor:
        """What a mirrored robot has in a group, shape (N, C); ``index_select`` takes a sixth of indexing's time."""
        return x.index_select(1, getattr(self, f"{group}_perm")) * getattr(self, f"{group}_sign")

    def to_lists(self) -> dict[str, Any]:
        """Plain numbers for :meth:`from_lists`."""
        maps = {g: (getattr(self, f"{g}_perm"), getattr(self, f"{g}_sign")) for g in self.groups}
        return {group: [perm.tolist(), sign.tolist()] for group, (perm, sign) in maps.items()}

    @classmethod
    def from_lists(cls, lists: Mapping[str, Any]) -> Sides:
        """What :meth:`to_lists` wrote, on the CPU even where a model is built without memory."""
        return cls(
            {
                group: (torch.tensor(perm, device="cpu"), torch.tensor(sign, device="cpu"))
                for group, (perm, sign) in lists.items()
            }
        )
