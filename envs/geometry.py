"""Quaternion (w, x, y, z) helpers on batched tensors."""

from __future__ import annotations

import torch
from torch import Tensor


def rotate_inverse(quat: Tensor, vector: Tensor) -> Tensor:
    """Express a world-frame vector in the frame of ``quat``, shapes (..., 4) and (..., 3)."""
    w, xyz = quat[..., :1], quat[..., 1:]
    t = 2.0 * torch.linalg.cross(xyz, vector)
    return vector - w * t + torch.linalg.cross(xyz, t)


def yaw_of(quat: Tensor) -> Tensor:
    """Heading about the world's z axis [rad], shape (...,)."""
    w, x, y, z = quat.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def quat_from_yaw(yaw: Tensor) -> Tensor:
    """Rotation about z by ``yaw`` [rad], shape (..., 4)."""
    half, zero = 0.5 * yaw, torch.zeros_like(yaw)
    return torch.stack([torch.cos(half), zero, zero, torch.sin(half)], dim=-1)


def rotate_yaw(yaw: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors about z by ``yaw`` [rad], shapes (...,) and (..., 3)."""
    c, s = torch.cos(yaw), torch.sin(yaw)
    x, y, z = vector.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)
