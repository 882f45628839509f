"""Where a robot differs from its own mirror image, as far as its URDF says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .slots import MIRROR_PERMUTATION, MIRROR_SIGN
from .spec import Array, RobotSpec
from .tree import Body, Pose
from .urdf import read_urdf

_FLIP = np.diag([1.0, -1.0, 1.0])
_UNITS = {
    "mass": "kg",
    "centre of mass": "m",
    "inertia": "kg m^2",
    "joint position": "m",
    "joint orientation": "rad",
    "limits": "rad",
}
_LENGTH = 0.1
"""Length that differences of positions are compared with [m]."""


@dataclass(frozen=True)
class Asymmetry:
    """One quantity that differs between a body and the mirror image of its partner (itself, if it is central)."""

    body: str
    partner: str
    quantity: str
    difference: float
    """Largest absolute difference, in ``unit``."""
    relative: float
    """The same relative to the quantity's own size, positions to 0.1 m, angles to 1 rad [-]."""

    def __str__(self) -> str:
        """Say it in one line."""
        whose = "its own" if self.body == self.partner else f"{self.partner}'s"
        size = f"{self.difference:.3g} {self.unit} ({self.relative:.2%})"
        return f"{self.quantity} of {self.body}: {size} off {whose} mirror image"

    @property
    def unit(self) -> str:
        """Unit of ``difference``."""
        return _UNITS[self.quantity]


def asymmetries(spec: RobotSpec, tolerance: float = 1e-9) -> list[Asymmetry]:
    """List every left/right difference above ``tolerance`` relative, largest first."""
    bodies = read_urdf(spec.urdf_path).bodies
    by_slot = {int(slot): body for slot, body in zip(spec.slots, bodies[1:], strict=True)}
    pairs = [(bodies[0], bodies[0])]
    pairs += [(by_slot[s], by_slot[int(MIRROR_PERMUTATION[s])]) for s in sorted(by_slot) if s >= MIRROR_PERMUTATION[s]]
    found = [item for body, partner in pairs for item in _compare(body, partner)] + _limit_asymmetries(spec)
    return sorted((item for item in found if item.relative > tolerance), key=lambda item: -item.relative)


def _compare(body: Body, partner: Body) -> list[Asymmetry]:
    mine, other = body.inertial, partner.inertial
    rows: list[tuple[str, Array, float]] = [
        ("mass", np.array([mine.mass - other.mass]), mine.mass),
        ("centre of mass", mine.com - _FLIP @ other.com, _LENGTH),
        ("inertia", mine.inertia - _FLIP @ other.inertia @ _FLIP, float(np.trace(mine.inertia)) / 3.0),
        ("joint position", body.pose.pos - _FLIP @ partner.pose.pos, _LENGTH),
        ("joint orientation", _turn(body.pose, partner.pose), 1.0),
    ]
    return [
        Asymmetry(body.name, partner.name, quantity, size := float(np.max(np.abs(difference))), size / scale)
        for quantity, difference, scale in rows
    ]


def _turn(pose: Pose, partner: Pose) -> Array:
    """Rotation vector, for small angles, between a frame and its partner's mirror image [rad], shape (3,)."""
    between = pose.rot.T @ _FLIP @ partner.rot @ _FLIP
    skew = 0.5 * (between - between.T)
    return np.array([skew[2, 1], skew[0, 2], skew[1, 0]])


def _limit_asymmetries(spec: RobotSpec) -> list[Asymmetry]:
    ends = np.sort(np.stack([spec.to_canonical(spec.joint_lower), spec.to_canonical(spec.joint_upper)]), axis=0)
    mirror = np.sort(ends[:, MIRROR_PERMUTATION] * MIRROR_SIGN, axis=0)
    names = dict(zip(spec.slots.tolist(), spec.joint_names, strict=True))
    found = []
    for slot, name in names.items():
        partner = int(MIRROR_PERMUTATION[slot])
        if slot >= partner:
            gap = float(np.max(np.abs(ends[:, slot] - mirror[:, slot])))
            found.append(Asymmetry(name, names[partner], "limits", gap, gap))
    return found
