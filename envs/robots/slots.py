"""The 32 action slots every robot shares, and their left/right mirror (paper, "Embodiment Alignment").

A slot means the same motion on every robot: canonical angles are ``sign * (q - zero_offset)``, zero standing straight
with hanging arms, positive by the right-hand rule about x forward (roll), y left (pitch), z up (yaw).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NUM_SLOTS = 32

_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee_pitch", "ankle_pitch", "ankle_roll")
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow_pitch", "wrist_roll", "wrist_pitch", "wrist_yaw")
_SIDES = ("right", "left")

SLOT_NAMES: tuple[str, ...] = (
    *(f"{side}_{joint}" for joint in _LEG for side in _SIDES),
    *(f"waist_{axis}" for axis in ("roll", "pitch", "yaw")),
    *(f"head_{axis}" for axis in ("roll", "pitch", "yaw")),
    *(f"{side}_{joint}" for joint in _ARM for side in _SIDES),
)
"""Slot names in slot order: legs 0-11 (right first, as in the paper), waist 12-14, head 15-17, arms 18-31."""

SLOT_INDEX: dict[str, int] = {name: index for index, name in enumerate(SLOT_NAMES)}


def _mirrored(name: str) -> str:
    if name.startswith("left_"):
        return "right_" + name.removeprefix("left_")
    return "left_" + name.removeprefix("right_") if name.startswith("right_") else name


MIRROR_PERMUTATION = np.array([SLOT_INDEX[_mirrored(name)] for name in SLOT_NAMES])
"""Slot whose value the mirrored robot has in each slot, shape (32,)."""

MIRROR_SIGN = np.array([1.0 if name.endswith("_pitch") else -1.0 for name in SLOT_NAMES])
"""Sign under the mirror: pitch keeps it, roll and yaw lose it, shape (32,)."""

AXES = ("roll", "pitch", "yaw")
"""Last word of every slot's name: about x forward, y left, z up."""

LEG_AND_WAIST_SLOTS = tuple(range(15))
HEAD_AND_ARM_SLOTS = tuple(range(15, NUM_SLOTS))

LEG_PITCH_SLOTS = tuple(i for i, n in enumerate(SLOT_NAMES) if n.endswith(("hip_pitch", "knee_pitch", "ankle_pitch")))
SHOULDER_PITCH_SLOTS = tuple(i for i, n in enumerate(SLOT_NAMES) if n.endswith("shoulder_pitch"))
HIP_YAW_SLOTS = tuple(i for i, n in enumerate(SLOT_NAMES) if n.endswith("hip_yaw"))
HIP_DEVIATION_SLOTS = tuple(i for i, n in enumerate(SLOT_NAMES) if n.endswith(("hip_roll", "hip_yaw")))
WAIST_SLOTS = tuple(i for i, n in enumerate(SLOT_NAMES) if n.startswith("waist"))
UPPER_SLOTS = tuple(range(12, NUM_SLOTS))
"""Every joint that is not a leg: waist, head and arms (HugWBC 4)."""


def slot_frame(name: str) -> NDArray[np.float64]:
    """Directions of roll, pitch and yaw in the base frame at canonical zero, one a row, shape (3, 3).

    A wrist's are named with the forearm pointing forward, and turn with it when it hangs.
    """
    hanging = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    return np.array(hanging) if "_wrist_" in name else np.eye(3)
