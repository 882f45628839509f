"""Averages of many scalars, kept on the device and read once."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


class RunningMeans:
    """Means of tagged scalars since the last :meth:`pop`.

    Adding costs a handful of tensor operations however many tags there are, and no transfer to the host. NaN means
    "no value this time" (the mean over no environments is NaN) and is left out.
    """

    def __init__(self) -> None:
        """Start without values."""
        self._rows: dict[tuple[str, ...], Tensor] = {}

    @torch.no_grad()
    def add(self, values: Mapping[str, Tensor | float]) -> None:
        """Add one value, a float or a tensor without dimensions, to each tag."""
        if not values:
            return
        tags = tuple(values)
        device = next((v.device for v in values.values() if isinstance(v, Tensor)), torch.device("cpu"))
        row = torch.stack([torch.as_tensor(v, dtype=torch.float32, device=device) for v in values.values()])
        known = ~row.isnan()
        row = torch.stack([row.nan_to_num(0.0, float("inf"), float("-inf")), known.to(row.dtype)])
        self._rows[tags] = self._rows[tags] + row if tags in self._rows else row

    def pop(self) -> dict[str, float]:
        """Return the means and start again; tags without any value are left out."""
        totals: dict[str, tuple[float, float]] = {}
        for tags, rows in self._rows.items():
            for tag, value, count in zip(tags, *rows.tolist(), strict=True):
                total, n = totals.get(tag, (0.0, 0.0))
                totals[tag] = (total + value, n + count)
        self._rows = {}
        return {tag: total / n for tag, (total, n) in totals.items() if n > 0}
