"""From a robot's YAML and URDF to a checked ``RobotSpec``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eagle_rl.config.yaml_file import read_yaml, to_plain
from eagle_rl.errors import ConfigError, RobotError, did_you_mean
from eagle_rl.paths import data_root

from .consistency import consistency_faults
from .slots import SLOT_INDEX, SLOT_NAMES
from .spec import COLLISION_LINKS, FALL_LINKS, FEET, Array, RobotSpec
from .tree import Tree
from .urdf import MAX_VALUE, as_sentence, read_urdf

ROLES = tuple(dict.fromkeys((*FALL_LINKS, "left_foot", "right_foot", "left_hand", "right_hand", *COLLISION_LINKS)))
"""Every role a robot's links must fill."""

REQUIRED = (
    "name",
    "title",
    "urdf",
    "base_link",
    "roles",
    "sole_centre_m",
    "nominal_height_m",
    "swing_height_m",
    "joints",
)
OPTIONAL = ("imu", "collision_excludes", "sources", "mesh_dir")
IMU_KEYS = ("link", "offset_m")
JOINT_NUMBERS = {
    "sign": -1.0,
    "zero_offset_rad": -math.inf,
    "default_angle_rad": -math.inf,
    "stiffness_nm_per_rad": 0.0,
    "damping_nms_per_rad": 0.0,
    "armature_kgm2": 0.0,
}
"""Numbers of each joint, with their lower bounds."""


def robot_names() -> tuple[str, ...]:
    """Names of the shipped robots, in alphabetical order."""
    return tuple(sorted(path.stem for path in (data_root() / "cfg" / "robots").glob("*.yaml")))


def load_robot(name_or_path: str | Path) -> RobotSpec:
    """Load a shipped robot by name, or any robot by the path of its YAML.

    Raises:
        RobotError: with every fault found in YAML and URDF, one a line.
    """
    path = _yaml_path(name_or_path)
    return _Draft(path, _read_yaml(path)).spec()


def _yaml_path(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        return path.resolve()
    names = robot_names()
    if str(name_or_path) not in names:
        raise RobotError(
            f"Unknown robot {str(name_or_path)!r}.{did_you_mean(str(name_or_path), names)} "
            f"Known: {', '.join(names)}; or give the path of a YAML."
        )
    return data_root() / "cfg" / "robots" / f"{name_or_path}.yaml"


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        data: dict[str, Any] = to_plain(read_yaml(path))
    except ConfigError as error:
        raise RobotError(f"Robot file {error}") from error
    return data


class _Draft:
    """A robot's YAML on its way to a ``RobotSpec``; gathers every fault."""

    def __init__(self, path: Path, data: dict[str, Any]) -> None:
        self.path = path
        self.data = data
        self.faults: list[str] = []

    def spec(self) -> RobotSpec:
        self._check_keys()
        urdf_path = self._path("urdf")
        try:
            tree = read_urdf(urdf_path)
        except RobotError as error:
            raise RobotError("\n".join([*self._messages(), str(error)])) from error
        spec = RobotSpec(
            name=str(self.data.get("name")),
            title=str(self.data.get("title")),
            urdf_path=urdf_path,
            yaml_path=self.path,
            total_mass=sum(body.inertial.mass for body in tree.bodies),
            sources=self._sources(),
            **self._joints(tree),
            **self._links(tree),
        )
        self._raise_faults()
        self.faults += consistency_faults(spec, tree)
        self._raise_faults()
        return spec

    def _messages(self) -> list[str]:
        return [as_sentence(f"{self.path}: {fault}") for fault in self.faults]

    def _raise_faults(self) -> None:
        if self.faults:
            raise RobotError("\n".join(self._messages()))

    def _check_keys(self) -> None:
        known = (*REQUIRED, *OPTIONAL)
        for key in self.data:
            if key not in known:
                self.faults.append(f"unknown key {key!r}.{did_you_mean(str(key), known)}")
        self.faults += [f"key {key!r} is missing" for key in REQUIRED if key not in self.data]
        name = self.data.get("name", "unnamed")
        if not isinstance(name, str) or not re.fullmatch(r"\w[\w.-]*", name):
            self.faults.append(f"name is {name!r:.80}, expected letters, digits, - and _: files are named after it")

    def _path(self, key: str) -> Path:
        """A path given relative to the YAML."""
        value = self.data.get(key)
        if not isinstance(value, str) or "\0" in value:
            self.faults.append(f"{key} is {value!r:.80}, expected a path relative to this file")
            return self.path
        return (self.path.parent / value).resolve()

    def _sources(self) -> dict[str, str]:
        sources = self.data.get("sources", {})
        if not isinstance(sources, dict):
            self.faults.append(f"sources is {sources!r:.80}, expected a mapping from a topic to its origin")
            return {}
        return {str(topic): str(origin) for topic, origin in sources.items()}

    def _mapping(self, value: object, where: str, keys: Sequence[str]) -> dict[str, Any]:
        """Check that ``value`` is a mapping with exactly ``keys``; faults are noted, an absent key is left out."""
        if not isinstance(value, dict):
            self.faults.append(f"{where} is {value!r:.80}, expected a mapping with {', '.join(keys)}")
            return {}
        for key in value:
            if key not in keys:
                self.faults.append(f"{where}: unknown key {key!r}.{did_you_mean(str(key), keys)}")
        missing = [key for key in keys if key not in value]
        if missing:
            self.faults.append(f"{where}: missing {', '.join(missing)}")
        return value

    def _number(self, value: object, where: str, lower: float = -math.inf) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_VALUE:
            self.faults.append(f"{where} is {value!r:.80}, expected a finite number")
            return 1.0
        if value < lower:
            self.faults.append(f"{where} is {value}, expected at least {lower:g}")
        return float(value)

    def _point(self, value: object, where: str) -> Array:
        if not isinstance(value, list) or len(value) != 3:
            self.faults.append(f"{where} is {value!r:.80}, expected three numbers [m]")
            return np.zeros(3)
        return np.array([self._number(part, where) for part in value])

    def _link(self, value: object, where: str, tree: Tree) -> str:
        """Resolve a link to the body that carries it."""
        if value not in tree.link_names:
            self.faults.append(
                f"{where}: no link {value!r:.80} in the URDF.{did_you_mean(str(value), tree.link_names)}"
            )
            return tree.bodies[0].name
        return tree.locate(str(value))[0].name

    def _links(self, tree: Tree) -> dict[str, Any]:
        data = self.data
        roles = self._mapping(data.get("roles"), "roles", ROLES)
        soles = self._mapping(data.get("sole_centre_m"), "sole_centre_m", FEET)
        if data.get("base_link") != tree.bodies[0].name:
            self.faults.append(
                f"base_link is {data.get('base_link')!r:.80}, but the URDF's root is {tree.bodies[0].name}"
            )
        imu = self._mapping(data.get("imu", {"link": tree.bodies[0].name, "offset_m": [0, 0, 0]}), "imu", IMU_KEYS)
        imu_link = self._link(imu.get("link"), "imu.link", tree)
        return {
            "base_link": tree.bodies[0].name,
            "link_roles": {role: self._link(roles.get(role), f"roles.{role}", tree) for role in ROLES},
            "sole_offsets": np.stack([self._sole(roles, soles, side, tree) for side in FEET]),
            "nominal_height": self._number(data.get("nominal_height_m"), "nominal_height_m", 0.05),
            "swing_height": self._number(data.get("swing_height_m"), "swing_height_m", 0.0),
            "imu_link": imu_link,
            "imu_offset": self._in_body(imu.get("link"), self._point(imu.get("offset_m"), "imu.offset_m"), tree),
            "collision_excludes": self._excludes(tree),
            "mesh_dir": self._mesh_dir(),
        }

    def _mesh_dir(self) -> Path | None:
        if self.data.get("mesh_dir") is None:
            return None
        folder = self._path("mesh_dir")
        if not folder.is_dir():
            self.faults.append(f"mesh_dir {folder} is not a folder; leave the key out to render primitives")
        return folder

    def _sole(self, roles: dict[str, Any], soles: dict[str, Any], side: str, tree: Tree) -> Array:
        point = self._point(soles.get(side), f"sole_centre_m.{side}")
        return self._in_body(roles.get(f"{side}_foot"), point, tree)

    def _in_body(self, link: object, point: Array, tree: Tree) -> Array:
        return tree.locate(str(link))[1].apply(point) if link in tree.link_names else point

    def _excludes(self, tree: Tree) -> tuple[tuple[str, str], ...]:
        pairs = self.data.get("collision_excludes") or []
        if not isinstance(pairs, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in pairs):
            self.faults.append(f"collision_excludes is {pairs!r:.80}, expected a list of pairs of links")
            return ()
        return tuple(
            (self._link(a, "collision_excludes", tree), self._link(b, "collision_excludes", tree)) for a, b in pairs
        )

    def _joints(self, tree: Tree) -> dict[str, Any]:
        names = tuple(joint.name for joint in tree.joints)
        entries = self._mapping(self.data.get("joints"), "joints", names)
        rows = [self._joint(name, entries[name]) for name in names if name in entries]
        slots = [row[0] for row in rows]
        for slot in sorted({slot for slot in slots if slots.count(slot) > 1}):
            users = [name for name, row in zip(names, rows, strict=False) if row[0] == slot]
            self.faults.append(f"slot {SLOT_NAMES[slot]} is claimed by {', '.join(users)}")
        numbers = np.array([row[1] for row in rows]).reshape(len(rows), len(JOINT_NUMBERS)).T
        fields = ("signs", "zero_offsets", "default_joint_pos", "stiffness", "damping", "armature")
        limits = np.array([(j.lower, j.upper, j.effort, j.velocity) for j in tree.joints]).reshape(len(names), 4).T
        limit_fields = ("joint_lower", "joint_upper", "effort_limit", "velocity_limit")
        return {
            "joint_names": names,
            "slots": np.array(slots, dtype=np.int64),
            **dict(zip(fields, numbers, strict=True)),
            **dict(zip(limit_fields, limits, strict=True)),
        }

    def _joint(self, name: str, entry: object) -> tuple[int, list[float]]:
        where = f"joints.{name}"
        entry = self._mapping(entry, where, ("slot", *JOINT_NUMBERS))
        slot = entry.get("slot")
        if not isinstance(slot, str) or slot not in SLOT_INDEX:
            self.faults.append(f"{where}.slot: unknown slot {slot!r:.80}.{did_you_mean(str(slot), SLOT_NAMES)}")
        numbers = [self._number(entry.get(key, 1.0), f"{where}.{key}", lower) for key, lower in JOINT_NUMBERS.items()]
        if numbers[0] not in (1.0, -1.0):
            self.faults.append(f"{where}.sign is {numbers[0]:g}, expected 1 or -1")
        return SLOT_INDEX.get(str(slot), 0), numbers
