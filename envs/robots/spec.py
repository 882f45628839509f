"""``RobotSpec``: everything the task knows about one robot, checked once when it is loaded."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .slots import NUM_SLOTS

Array = NDArray[np.float64]

FEET = ("left", "right")
"""Order of every per-foot quantity."""

COLLISION_LINKS = ("left_elbow", "right_elbow", "torso", "left_hip", "right_hip", "left_knee", "right_knee")
"""Roles of the links whose contacts the critic sees, one body each on every robot (HugWBC 5)."""

FALL_LINKS = ("torso", "pelvis", "head")
"""Roles of the links whose touching the ground ends an episode (HugWBC 9)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotSpec:
    """One robot, resolved against its URDF.

    Joint arrays are in native order, the order of the URDF's kinematic tree, which is also that of MuJoCo's joints
    after the free joint and of its actuators. Angles are native unless a name says canonical.
    """

    name: str
    title: str
    urdf_path: Path
    yaml_path: Path

    joint_names: tuple[str, ...]
    slots: NDArray[np.int64]
    """Slot of each joint, shape (n,)."""
    signs: Array
    """+1 or -1, shape (n,): canonical = sign * (q - zero_offset)."""
    zero_offsets: Array
    """[rad], shape (n,)."""
    default_joint_pos: Array
    """Default pose, native [rad], shape (n,)."""
    joint_lower: Array
    """[rad], shape (n,)."""
    joint_upper: Array
    """[rad], shape (n,)."""
    effort_limit: Array
    """[N m], shape (n,)."""
    velocity_limit: Array
    """[rad/s], shape (n,)."""
    stiffness: Array
    """kp [N m/rad], shape (n,)."""
    damping: Array
    """kd [N m s/rad], shape (n,)."""
    armature: Array
    """Reflected rotor inertia [kg m^2], shape (n,)."""

    base_link: str
    link_roles: dict[str, str]
    """Link (after merging fixed joints) of each role in COLLISION_LINKS, FALL_LINKS, left_foot, right_foot, left_hand,
    right_hand."""
    sole_offsets: Array
    """Sole centre in each foot link's frame [m], shape (2, 3), in FEET order."""
    total_mass: float
    """[kg]"""
    nominal_height: float
    """Height of the base frame above the sole in the default pose [m] (HugWBC 2)."""
    swing_height: float
    """Apex of the sole in swing above the ground [m] (HugWBC 1)."""
    imu_link: str
    imu_offset: Array
    """IMU position in ``imu_link`` [m], shape (3,)."""
    collision_excludes: tuple[tuple[str, str], ...]
    """Pairs of links that never collide."""
    mesh_dir: Path | None = None
    """Folder of the vendor's meshes a user may point at for rendering; never shipped."""
    sources: dict[str, str] = field(default_factory=dict)
    """Where each group of numbers comes from."""

    @property
    def num_joints(self) -> int:
        """Degrees of freedom n."""
        return len(self.joint_names)

    @property
    def slot_mask(self) -> NDArray[np.bool_]:
        """True where the robot has a joint, shape (32,)."""
        mask = np.zeros(NUM_SLOTS, dtype=bool)
        mask[self.slots] = True
        return mask

    def selection_matrix(self) -> Array:
        """S_i of the paper: native = S_i @ slots, shape (n, 32)."""
        matrix = np.zeros((self.num_joints, NUM_SLOTS))
        matrix[np.arange(self.num_joints), self.slots] = 1.0
        return matrix

    def permutation_matrix(self) -> Array:
        """P_i of the paper: slots = P_i @ [native; 0], shape (32, 32)."""
        absent = [slot for slot in range(NUM_SLOTS) if slot not in set(self.slots.tolist())]
        matrix = np.zeros((NUM_SLOTS, NUM_SLOTS))
        matrix[[*self.slots.tolist(), *absent], np.arange(NUM_SLOTS)] = 1.0
        return matrix

    def to_slots(self, native: Array) -> Array:
        """Scatter per-joint numbers (no sign, no offset) into slots, zero elsewhere: (..., n) -> (..., 32)."""
        out = np.zeros((*native.shape[:-1], NUM_SLOTS))
        out[..., self.slots] = native
        return out

    def to_canonical(self, joint_pos: Array) -> Array:
        """Native joint angles [rad] to canonical ones in slots: (..., n) -> (..., 32)."""
        return self.to_slots(self.signs * (joint_pos - self.zero_offsets))

    def to_native(self, canonical: Array) -> Array:
        """Canonical angles in slots [rad] to native joint angles: (..., 32) -> (..., n)."""
        return self.signs * canonical[..., self.slots] + self.zero_offsets
