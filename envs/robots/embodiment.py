"""o_ea, the embodiment-aware observation: what the body is, as numbers (paper, "Embodiment-aware Observation").

Mass, centre of mass and inertia of torso and feet come from Pinocchio, links rigidly attached to them included, and
follow every environment's randomization. ``extended`` adds limb lengths, joint axes and tree structure, the paper's
own outlook.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import pinocchio
import torch
from torch import Tensor

from eagle_rl.config.schema import RandomizationCfg

from .load import load_robot
from .spec import Array, RobotSpec
from .structure import STRUCTURE_DIM, resized_structure, structure_vector

Descriptor = Literal["paper", "extended"]

EMBODIMENT_LINKS = ("torso", "left_foot", "right_foot")
"""Roles of the m = 3 links described (paper)."""

LINK_DIM = 10
"""Numbers per link: mass [kg]; centre of mass x, y, z [m] and inertia about it xx, yy, zz, xy, xz, yz [kg m^2], in the
link's frame."""

LINK_CHANNELS = (
    ("mass", "kg"),
    *((f"CoM {axis}", "m") for axis in "xyz"),
    *((f"inertia {axes}", "kg m²") for axes in ("xx", "yy", "zz", "xy", "xz", "yz")),
)
"""Name and unit of each of those numbers."""

REFERENCE_ROBOTS = ("h1", "g1", "t1", "n1", "adam")
"""The robots whose spread standardises the channels, so that a checkpoint means the same with any set of robots."""

_MASS_FLOOR, _INERTIA_FLOOR = 0.1, 0.1
"""Least standard deviation, relative to the reference robots' mean mass and mean moment of inertia [-]."""


@dataclass
class BodyChanges:
    """What randomization did to ``EMBODIMENT_LINKS`` of each environment."""

    length_scale: Tensor
    """Factor on all lengths, shape (N,); inertia grows with its square."""
    mass_scale: Tensor
    """Factor on mass and inertia, shape (N, 3)."""
    added_mass: Tensor
    """Point mass added at the centre of mass [kg], shape (N, 3)."""
    com_offset: Tensor
    """Shift of the centre of mass with everything on it [m], shape (N, 3, 3)."""


def pinocchio_model(spec: RobotSpec) -> pinocchio.Model:
    """Pinocchio's own reading of the robot's URDF, on a free-flyer base."""
    return pinocchio.buildModelFromXML(spec.urdf_path.read_text(encoding="utf-8"), pinocchio.JointModelFreeFlyer())


def nominal_embodiment(spec: RobotSpec) -> Array:
    """Describe torso, left and right foot of the unrandomized robot, shape (3, 10), see ``LINK_DIM``."""
    model = pinocchio_model(spec)
    return np.stack([_link_numbers(model, spec.link_roles[role]) for role in EMBODIMENT_LINKS])


def _link_numbers(model: pinocchio.Model, link: str) -> Array:
    frame = model.frames[model.getFrameId(link, pinocchio.FrameType.BODY)]
    merged = model.inertias[frame.parentJoint].se3Action(frame.placement.inverse())
    tensor = merged.inertia
    moments = (*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2])
    return np.array([merged.mass, *merged.lever, *moments])


def embodiment_vector(nominal: Tensor, changes: BodyChanges) -> Tensor:
    """Describe randomized links: (N, 3, 10) and their changes to (N, 30), in SI units.

    An added point mass at the centre of mass changes neither its place nor the inertia about it.
    """
    scale = changes.mass_scale.unsqueeze(-1)
    length = changes.length_scale.reshape(-1, 1, 1)
    mass = nominal[..., :1] * scale + changes.added_mass.unsqueeze(-1)
    centre = nominal[..., 1:4] * length + changes.com_offset
    return torch.cat([mass, centre, nominal[..., 4:] * scale * length.square()], dim=-1).flatten(1)


def embodiment_dim(descriptor: Descriptor) -> int:
    """Length of o_ea."""
    return len(EMBODIMENT_LINKS) * LINK_DIM + (STRUCTURE_DIM if descriptor == "extended" else 0)


def pooled_embodiment(
    robots: Sequence[RobotSpec], robot_id: Tensor, changes: BodyChanges, descriptor: Descriptor
) -> Tensor:
    """Standardised o_ea of every environment, shape (N, embodiment_dim), with the dtype and device of ``changes``.

    Args:
        robots: the pool's robots.
        robot_id: index into ``robots``, shape (N,).
        changes: what randomization did to each environment.
        descriptor: ``paper`` or ``extended``.
    """
    like = changes.mass_scale
    nominal = like.new_tensor(np.stack([nominal_embodiment(spec) for spec in robots]))
    mean, std = (like.new_tensor(x) for x in reference_statistics())
    rows = (embodiment_vector(nominal[robot_id], changes) - mean) / std
    if descriptor == "paper":
        return rows
    structure = like.new_tensor(np.stack([structure_vector(spec) for spec in robots]))
    return torch.cat([rows, resized_structure(structure[robot_id], changes.length_scale)], dim=1)


@cache
def reference_statistics() -> tuple[Array, Array]:
    """Mean and standard deviation of the thirty channels, shape (30,) each.

    Taken over the reference robots, their mirror images, so that the left/right mirror of a standardised vector is
    exact, and the default randomization.
    """
    cfg = RandomizationCfg()
    moments = [_moments(load_robot(name), cfg) for name in REFERENCE_ROBOTS]
    moments += [(mirrored(mean, sign=True), mirrored(variance, sign=False)) for mean, variance in moments]
    means, variances = (np.stack(x) for x in zip(*moments, strict=True))
    mean = means.mean(axis=0)
    std = np.sqrt(variances.mean(axis=0) + means.var(axis=0))
    floor = np.zeros_like(std)
    floor[:, 0] = _MASS_FLOOR * mean[:, 0]
    floor[:, 4:] = _INERTIA_FLOOR * mean[:, 4:7].mean(axis=1, keepdims=True)
    return mean.ravel(), np.maximum(std, floor).ravel()


def _moments(spec: RobotSpec, cfg: RandomizationCfg) -> tuple[Array, Array]:
    """Mean and variance of each channel of one robot under randomization, shape (3, 10) each."""
    nominal = nominal_embodiment(spec)
    scale_mean, scale_var = _uniform(cfg.link_mass_scale)
    mean, variance = nominal * scale_mean, nominal**2 * scale_var
    mean[:, 1:4], variance[:, 1:4] = nominal[:, 1:4], _uniform(cfg.link_com_offset)[1]
    for row, role in enumerate(EMBODIMENT_LINKS):
        if spec.link_roles[role] == spec.base_link:
            added_mean, added_var = _uniform(cfg.base_mass_ratio)
            mean[row, 0] += spec.total_mass * added_mean
            variance[row, 0] += spec.total_mass**2 * added_var
            variance[row, 1:3] += _uniform(cfg.base_com_offset)[1]
    return mean, variance


def _uniform(bounds: tuple[float, float]) -> tuple[float, float]:
    low, high = bounds
    return 0.5 * (low + high), (high - low) ** 2 / 12.0


def mirrored(rows: Array, *, sign: bool) -> Array:
    """Mirror (3, 10) channels left to right: the feet change places, y and the products xy, yz flip if ``sign``."""
    flips = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0])
    return np.asarray(rows[[0, 2, 1]] * (flips if sign else 1.0))
