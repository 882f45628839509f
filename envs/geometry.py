"""Quaternion (w, x, y, z) and frame helpers on batched tensors."""

from __future__ import annotations

import torch
from torch import Tensor


def rotate_inverse(quat: Tensor, vector: Tensor) -> Tensor:
    """Express a world-frame vector in the frame of ``quat``, shapes (..., 4) and (..., 3)."""
    w, xyz = quat[..., :1], quat[..., 1:]
    t = 2.0 * torch.linalg.cross(xyz, vector)
    return vector - w * t + torch.linalg.cross(xyz, t)


def heading_of(quat: Tensor) -> Tensor:
    """(cos, sin) of the yaw about the world's z axis, shape (..., 2)."""
    w, x, y, z = quat.unbind(-1)
    half_x_axis = torch.stack((0.5 - torch.addcmul(y * y, z, z), torch.addcmul(w * z, x, y)), dim=-1)
    return torch.nn.functional.normalize(half_x_axis, dim=-1)


def from_yaw_frame(heading: Tensor, vector: Tensor) -> Tensor:
    """Express in the world a vector given in the frame of ``heading`` = (cos, sin), shapes (..., 2) and (..., 3)."""
    (c, s), (x, y, z) = heading.unbind(-1), vector.unbind(-1)
    return torch.stack((torch.addcmul(c * x, s, y, value=-1.0), torch.addcmul(c * y, s, x), z), dim=-1)


def into_yaw_frame(heading: Tensor, vector: Tensor) -> Tensor:
    """Express a world-frame vector in the frame of ``heading`` = (cos, sin), shapes (..., 2) and (..., 3)."""
    (c, s), (x, y, z) = heading.unbind(-1), vector.unbind(-1)
    return torch.stack((torch.addcmul(c * x, s, y), torch.addcmul(c * y, s, x, value=-1.0), z), dim=-1)


def quat_from_yaw(yaw: Tensor) -> Tensor:
    """Rotation about z by ``yaw`` [rad], shape (..., 4)."""
    half, zero = 0.5 * yaw, torch.zeros_like(yaw)
    return torch.stack([torch.cos(half), zero, zero, torch.sin(half)], dim=-1)
