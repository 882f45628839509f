"""The learner's own checks on what the environment hands it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from eagle_rl.errors import HealthError


def require_finite(tensors: Mapping[str, Tensor], robot: Tensor, robot_names: Sequence[str]) -> None:
    """Raise :class:`HealthError` naming the tensor, the robots and the environments if a number is not finite.

    Args:
        tensors: float tensors by name, rows are environments.
        robot: index of each environment's robot, shape (N,).
        robot_names: names of the robots.
    """
    if torch.isfinite(torch.stack([tensor.sum() for tensor in tensors.values()]).sum()):
        return
    for name, tensor in tensors.items():
        bad = (~torch.isfinite(tensor).reshape(len(tensor), -1).all(dim=1)).nonzero().flatten()
        if len(bad):
            names = sorted({robot_names[i] for i in robot[bad].tolist()})
            value = tensor[bad[0]].reshape(-1)
            column = int((~torch.isfinite(value)).nonzero()[0])
            raise HealthError(
                f"{name} is not finite: {value[column].item()} in column {column}; robots {', '.join(names)}; "
                f"environments {bad[:16].tolist()}{' ...' if len(bad) > 16 else ''}. "
                "The environment let an unsound state through; look at Health/* of the last iterations."
            )
