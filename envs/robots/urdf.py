"""A safe reader of URDF files.

Only what physics needs is read. Meshes, transmissions and extension elements are ignored, document types and entities
are refused, and sizes are capped, so that a stranger's file can do no more than be rejected.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np

from eagle_rl.errors import RobotError, did_you_mean

from .spec import Array
from .tree import IDENTITY, Inertial, Joint, Link, Pose, Shape, ShapeKind, Tree, merge_fixed, rpy_rotation

MAX_FILE_BYTES = 10_000_000
MAX_LINKS = 500
MAX_LENGTH = 10.0
"""Largest distance or size believed [m]."""
MAX_MASS = 1000.0
"""Largest mass of one link believed [kg]."""
MIN_BODY_MASS = 0.01
"""Least mass of a moving body, with all that is fixed to it [kg]; less is a link whose inertia was forgotten."""
MAX_VALUE = 1e6
"""Largest number believed anywhere else."""

Rgba = tuple[float, float, float, float]
Named = TypeVar("Named", Link, Joint)

_DECLARATION = re.compile(r"<!(DOCTYPE|ENTITY|ELEMENT|ATTLIST|NOTATION)", re.IGNORECASE)
_PRIMITIVES: tuple[tuple[str, ShapeKind, tuple[tuple[str, int, float], ...]], ...] = (
    ("box", "box", (("size", 3, 0.5),)),
    ("sphere", "sphere", (("radius", 1, 1.0),)),
    ("cylinder", "capsule", (("radius", 1, 1.0), ("length", 1, 0.5))),
)
"""URDF tag, our kind, and its attributes: name, how many numbers, factor to the half sizes of ``Shape``."""
_GREY: Rgba = (0.6, 0.6, 0.6, 1.0)


def read_urdf(path: Path) -> Tree:
    """Read and check a URDF file; a ``RobotError`` lists every fault found."""
    return _Reader(path).read(_parse_xml(path))


def _parse_xml(path: Path) -> ET.Element:
    try:
        raw = path.read_bytes() if path.stat().st_size <= MAX_FILE_BYTES else None
    except OSError as error:
        raise RobotError(f"URDF {path} cannot be read: {error.strerror}. Check `urdf` in the robot's YAML.") from error
    if raw is None:
        raise RobotError(f"URDF {path} is larger than {MAX_FILE_BYTES} bytes; keep meshes in files of their own.")
    try:
        text = raw.decode("utf-8")
        declared = _DECLARATION.search(text) is not None
        root = None if declared else ET.fromstring(text)
    except (UnicodeDecodeError, ET.ParseError, ValueError) as error:
        raise RobotError(f"URDF {path} is not well-formed XML in UTF-8: {error}.") from error
    if root is None:
        raise RobotError(f"URDF {path} declares a document type or entities; remove them.")
    if root.tag != "robot":
        raise RobotError(f"URDF {path} starts with <{root.tag}>, expected <robot>.")
    return root


class _Reader:
    """Turns XML into a tree and gathers every fault on the way."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.faults: list[str] = []

    def read(self, root: ET.Element) -> Tree:
        elements = root.findall("link")
        if len(elements) > MAX_LINKS:
            raise RobotError(f"URDF {self.path} has {len(elements)} links; at most {MAX_LINKS} are read.")
        colours = {m.get("name", ""): self._rgba(m, {}) for m in root.findall("material")}
        links = self._by_name([self._link(element, colours) for element in elements], "link")
        joints = self._by_name([self._joint(element) for element in root.findall("joint")], "joint")
        self._check_references(links, joints.values())
        self._raise_faults()
        tree = merge_fixed(root.get("name", ""), links, list(joints.values()), self._root(links, joints.values()))
        self._check_tree(tree, links)
        self._raise_faults()
        return tree

    def _raise_faults(self) -> None:
        if self.faults:
            raise RobotError("\n".join(as_sentence(f"URDF {self.path}: {fault}") for fault in self.faults))

    def _by_name(self, items: list[Named], what: str) -> dict[str, Named]:
        out: dict[str, Named] = {}
        for item in items:
            if not item.name or item.name in out:
                self.faults.append(f"{what} name {item.name!r} is empty or used twice")
            out[item.name] = item
        return out

    def _numbers(
        self, element: ET.Element | None, key: str, count: int, default: str, where: str, bound: float = MAX_VALUE
    ) -> Array:
        """Read ``count`` finite numbers of an attribute; a fault is noted and zeros are returned if they are not."""
        text = default if element is None else element.get(key, default)
        try:
            values = np.array([float(part) for part in text.split()])
        except ValueError:
            values = np.array([math.nan])
        if len(values) != count or not np.all(np.abs(values) <= bound):
            self.faults.append(f"{where}: {key}={text!r}, expected {count} finite number(s) of at most {bound:g}")
            return np.zeros(count)
        return values

    def _pose(self, element: ET.Element | None, where: str) -> Pose:
        origin = None if element is None else element.find("origin")
        if origin is None:
            return IDENTITY
        rot = rpy_rotation(self._numbers(origin, "rpy", 3, "0 0 0", where))
        return Pose(rot=rot, pos=self._numbers(origin, "xyz", 3, "0 0 0", where, MAX_LENGTH))

    def _rgba(self, material: ET.Element | None, colours: dict[str, Rgba]) -> Rgba:
        if material is None:
            return _GREY
        colour = material.find("color")
        if colour is None:
            return colours.get(material.get("name", ""), _GREY)
        r, g, b, a = np.clip(self._numbers(colour, "rgba", 4, "0.6 0.6 0.6 1", "material"), 0.0, 1.0)
        return float(r), float(g), float(b), float(a)

    def _link(self, element: ET.Element, colours: dict[str, Rgba]) -> Link:
        name = element.get("name", "")
        shapes = [
            shape
            for tag in ("visual", "collision")
            for child in element.findall(tag)
            if (shape := self._shape(child, tag == "visual", colours, f"link {name}")) is not None
        ]
        return Link(
            name=name,
            inertial=self._inertial(element, f"link {name}"),
            shapes=tuple(shapes),
            collision_mesh=element.find("collision/geometry/mesh") is not None,
        )

    def _shape(self, element: ET.Element, visual: bool, colours: dict[str, Rgba], where: str) -> Shape | None:
        geometry = element.find("geometry")
        for tag, kind, attributes in _PRIMITIVES:
            primitive = None if geometry is None else geometry.find(tag)
            if primitive is None:
                continue
            parts = [self._numbers(primitive, key, count, "", where, MAX_LENGTH) for key, count, _ in attributes]
            if any(np.any(part <= 0.0) for part in parts):
                self.faults.append(f"{where}: a {tag} of size {[p.tolist() for p in parts]}, expected positive numbers")
            halves = [part * factor for part, (_, _, factor) in zip(parts, attributes, strict=True)]
            return Shape(
                kind=kind,
                size=tuple(np.concatenate(halves).tolist()),
                pose=self._pose(element, where),
                rgba=self._rgba(element.find("material"), colours),
                visual=visual,
            )
        return None

    def _inertial(self, link: ET.Element, where: str) -> Inertial | None:
        element = link.find("inertial")
        if element is None:
            return None
        mass = float(self._numbers(element.find("mass"), "value", 1, "", where, MAX_MASS)[0])
        if mass < 0.0 or (mass == 0.0 and element.find("mass") is not None):
            self.faults.append(f"{where}: mass is {mass:g} kg, expected more than 0")
        tensor = element.find("inertia")
        keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        xx, yy, zz, xy, xz, yz = (float(self._numbers(tensor, key, 1, "", where)[0]) for key in keys)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        pose = self._pose(element, where)
        if not _is_inertia(inertia):
            self.faults.append(
                f"{where}: inertia {inertia.tolist()} is not that of a body: expected positive principal moments, "
                "none larger than the sum of the other two"
            )
        return Inertial(mass=mass, com=np.zeros(3), inertia=inertia).seen_from(pose)

    def _joint(self, element: ET.Element) -> Joint:
        name = element.get("name", "")
        where = f"joint {name}"
        kind = element.get("type", "")
        if kind not in ("revolute", "fixed"):
            self.faults.append(
                f"{where}: type {kind!r}, expected revolute or fixed"
                + ("; give a continuous joint limits and call it revolute" if kind == "continuous" else "")
            )
        if element.find("mimic") is not None:
            self.faults.append(f"{where}: mimic joints are not supported")
        fixed = kind != "revolute"
        axis = np.array([1.0, 0.0, 0.0]) if fixed else self._axis(element, where)
        lower, upper, effort, velocity = (0.0,) * 4 if fixed else self._limits(element.find("limit"), where)
        parent, child = element.find("parent"), element.find("child")
        return Joint(
            name=name,
            fixed=fixed,
            parent="" if parent is None else parent.get("link", ""),
            child="" if child is None else child.get("link", ""),
            pose=self._pose(element, where),
            axis=axis,
            lower=lower,
            upper=upper,
            effort=effort,
            velocity=velocity,
        )

    def _axis(self, element: ET.Element, where: str) -> Array:
        axis = self._numbers(element.find("axis"), "xyz", 3, "1 0 0", where)
        length = float(np.linalg.norm(axis))
        if length < 1e-6:
            self.faults.append(f"{where}: axis {axis.tolist()} has no direction")
            return np.array([1.0, 0.0, 0.0])
        return np.asarray(axis / length)

    def _limits(self, element: ET.Element | None, where: str) -> tuple[float, float, float, float]:
        keys = ("lower", "upper", "effort", "velocity")
        lower, upper, effort, velocity = (float(self._numbers(element, key, 1, "", where)[0]) for key in keys)
        if not lower < upper:
            self.faults.append(f"{where}: limits [{lower:g}, {upper:g}] rad, expected lower < upper")
        if effort <= 0.0 or velocity <= 0.0:
            self.faults.append(f"{where}: effort {effort:g} N m and velocity {velocity:g} rad/s must be positive")
        return lower, upper, effort, velocity

    def _check_references(self, links: dict[str, Link], joints: Iterable[Joint]) -> None:
        parents: dict[str, str] = {}
        for joint in joints:
            for role, link in (("parent", joint.parent), ("child", joint.child)):
                if link not in links:
                    self.faults.append(f"joint {joint.name}: unknown {role} link {link!r}.{did_you_mean(link, links)}")
            if joint.child in parents:
                self.faults.append(f"link {joint.child} hangs on two joints, {parents[joint.child]} and {joint.name}")
            parents[joint.child] = joint.name

    def _root(self, links: dict[str, Link], joints: Iterable[Joint]) -> str:
        children = {joint.child for joint in joints}
        roots = [name for name in links if name not in children]
        if len(roots) != 1:
            self.faults.append(f"links without a parent: {roots or 'none'}, expected exactly one, the base")
        self._raise_faults()
        return roots[0]

    def _check_tree(self, tree: Tree, links: dict[str, Link]) -> None:
        unreached = set(links) - set(tree.link_names)
        if unreached:
            self.faults.append(f"links {sorted(unreached)} form a loop apart from the base")
        for body in tree.bodies:
            if body.inertial.mass < MIN_BODY_MASS:
                self.faults.append(
                    f"link {body.name} moves but weighs {body.inertial.mass:g} kg with all that is fixed to it, "
                    f"expected at least {MIN_BODY_MASS:g}; give it an <inertial>"
                )


def as_sentence(fault: str) -> str:
    """End a fault with a full stop unless it ends already."""
    return fault if fault.endswith((".", "?")) else f"{fault}."


def _is_inertia(inertia: Array) -> bool:
    """Whether a tensor is positive definite and obeys the triangle inequality."""
    moments = np.linalg.eigvalsh(inertia)
    return bool(moments[0] > 0.0 and moments[2] <= (moments[0] + moments[1]) * (1.0 + 1e-6))
