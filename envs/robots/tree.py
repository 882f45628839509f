"""The kinematic tree of a robot: joints, inertias and primitive shapes, with fixed joints merged into bodies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .spec import Array

ShapeKind = Literal["box", "sphere", "capsule"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """A frame seen from another: rotation (3, 3) and origin (3,) [m]."""

    rot: Array
    pos: Array

    def __matmul__(self, other: Pose) -> Pose:
        """Chain two poses, the right one expressed in the left one's frame."""
        return Pose(rot=self.rot @ other.rot, pos=self.pos + self.rot @ other.pos)

    def apply(self, point: Array) -> Array:
        """Express a point of this frame in its parent's frame, shape (3,)."""
        return self.pos + self.rot @ point


IDENTITY = Pose(rot=np.eye(3), pos=np.zeros(3))


@dataclass(frozen=True, kw_only=True, eq=False)
class Inertial:
    """Mass [kg], centre of mass (3,) [m] and inertia about it (3, 3) [kg m^2], all along the owner's axes."""

    mass: float
    com: Array
    inertia: Array

    def seen_from(self, pose: Pose) -> Inertial:
        """Express it in the frame in which its own frame has ``pose``."""
        return Inertial(mass=self.mass, com=pose.apply(self.com), inertia=pose.rot @ self.inertia @ pose.rot.T)


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A primitive in its body's frame.

    ``size`` [m] is half extents of a box, radius of a sphere, or radius and half length of a capsule: a URDF cylinder
    is read as the capsule whose hemispheres sit on the cylinder's two end faces.
    """

    kind: ShapeKind
    size: tuple[float, ...]
    pose: Pose
    rgba: tuple[float, float, float, float]
    visual: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Joint:
    """A URDF joint: ``pose`` of the child's frame in the parent's at angle 0, unit ``axis`` in the child's frame."""

    name: str
    fixed: bool
    parent: str
    child: str
    pose: Pose
    axis: Array
    lower: float
    upper: float
    effort: float
    velocity: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """A URDF link."""

    name: str
    inertial: Inertial | None
    shapes: tuple[Shape, ...]
    collision_mesh: bool
    """Whether a mesh was to collide; it is not among ``shapes``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """A link with everything rigidly attached to it.

    ``joint`` moves it against body number ``parent``; ``pose`` is that of the joint's zero in the parent body. Both are
    absent on the root. ``members`` are the poses of all its links in its frame, its own name first.
    """

    name: str
    parent: int
    joint: Joint | None
    pose: Pose
    inertial: Inertial
    shapes: tuple[Shape, ...]
    collision_mesh: bool
    members: dict[str, Pose]

    @property
    def can_touch(self) -> bool:
        """Whether it has a collision shape."""
        return any(not shape.visual for shape in self.shapes)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tree:
    """Bodies depth first in the order of the file, so that body i > 0 belongs to joint i - 1 of the robot."""

    name: str
    bodies: tuple[Body, ...]

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Moving joints in native order."""
        return tuple(body.joint for body in self.bodies if body.joint is not None)

    @property
    def link_names(self) -> tuple[str, ...]:
        """All links, merged ones included."""
        return tuple(name for body in self.bodies for name in body.members)

    def locate(self, link: str) -> tuple[Body, Pose]:
        """Return the body that carries ``link`` and the link's pose in it."""
        return next((body, body.members[link]) for body in self.bodies if link in body.members)

    def forward(self, joint_pos: Sequence[float] | Array) -> dict[str, Pose]:
        """Poses of all bodies in the root's frame at native joint angles [rad], shape (n,)."""
        poses: list[Pose] = [IDENTITY]
        for body, angle in zip(self.bodies[1:], joint_pos, strict=True):
            assert body.joint is not None
            turn = Pose(rot=axis_rotation(body.joint.axis, float(angle)), pos=np.zeros(3))
            poses.append(poses[body.parent] @ body.pose @ turn)
        return {body.name: pose for body, pose in zip(self.bodies, poses, strict=True)}


def axis_rotation(axis: Array, angle: float) -> Array:
    """Rotation by ``angle`` [rad] about the unit ``axis``, shape (3, 3)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross)


def rpy_rotation(rpy: Array) -> Array:
    """Rotation of URDF's fixed-axis roll, pitch, yaw [rad], shape (3, 3)."""
    roll, pitch, yaw = np.eye(3)
    return axis_rotation(yaw, rpy[2]) @ axis_rotation(pitch, rpy[1]) @ axis_rotation(roll, rpy[0])


def combine(parts: Sequence[Inertial]) -> Inertial:
    """Inertial of several rigidly joined parts, all given in one frame."""
    mass = sum(part.mass for part in parts)
    if mass <= 0.0:
        return Inertial(mass=mass, com=np.zeros(3), inertia=np.zeros((3, 3)))
    com = sum((part.mass * part.com for part in parts), start=np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for part in parts:
        arm = part.com - com
        inertia += part.inertia + part.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Inertial(mass=mass, com=com, inertia=inertia)


def merge_fixed(name: str, links: dict[str, Link], joints: Sequence[Joint], root: str) -> Tree:
    """Walk the tree depth first and merge every fixed joint's child into the body it hangs on."""
    children: dict[str, list[Joint]] = {link: [] for link in links}
    for joint in joints:
        children[joint.parent].append(joint)
    heads: list[tuple[Joint | None, int, Pose]] = []
    members: list[dict[str, Pose]] = []
    stack: list[tuple[str, Joint | None, int, Pose]] = [(root, None, -1, IDENTITY)]
    while stack:
        link, moved_by, owner, pose = stack.pop()
        if moved_by is None or not moved_by.fixed:
            heads.append((moved_by, owner, pose))
            members.append({})
            owner, pose = len(heads) - 1, IDENTITY
        members[owner][link] = pose
        stack.extend((child.child, child, owner, pose @ child.pose) for child in reversed(children[link]))
    bodies = [_merged(*head, links, parts) for head, parts in zip(heads, members, strict=True)]
    return Tree(name=name, bodies=tuple(bodies))


def _merged(joint: Joint | None, owner: int, pose: Pose, links: dict[str, Link], members: dict[str, Pose]) -> Body:
    inertials = [inertial.seen_from(at) for name, at in members.items() if (inertial := links[name].inertial)]
    shapes = [
        Shape(kind=s.kind, size=s.size, pose=at @ s.pose, rgba=s.rgba, visual=s.visual)
        for name, at in members.items()
        for s in links[name].shapes
    ]
    return Body(
        name=next(iter(members)),
        parent=owner,
        joint=joint,
        pose=pose,
        inertial=combine(inertials),
        shapes=tuple(shapes),
        collision_mesh=any(links[name].collision_mesh for name in members),
        members=members,
    )
