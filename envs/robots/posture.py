"""The pose a robot rests in at a commanded height and pitch: legs bent so that feet stay flat and balance is kept."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio

from .embodiment import pinocchio_model
from .slots import NUM_SLOTS, SLOT_INDEX
from .spec import FEET, Array, RobotSpec

HEIGHTS = tuple(np.linspace(-0.4, 0.0, 9).tolist())
PITCHES = tuple(np.linspace(-0.4, 0.7, 12).tolist())
"""Nodes of :func:`posture_table`: height offset [m] and pitch [rad]. They span the finishing ranges of the paper's
commands and 0.1 to 0.2 more; published policies interpolate between just these, so they stay."""

PITCH_JOINTS = ("hip_pitch", "knee_pitch", "ankle_pitch")
"""What bends, the same on both legs."""
POSTURE_SLOTS = tuple(tuple(SLOT_INDEX[f"{side}_{joint}"] for joint in PITCH_JOINTS) for side in FEET)
"""Slots of those joints, (2, 3)."""

_WEIGHTS = np.array([1.0, 0.5, 1.0])
"""Of tilt [1/rad], height and balance [1/m]: where limits forbid having all, a robot squats less but on its soles."""
_BALANCE_MARGIN = 0.04
"""So far off balance [m] counts twice as much as its weight says, and more the farther: without, N1 would rest over its
heels, and tips over them after some ten seconds (docs/experiments.md, 39)."""
_ITERATIONS = 40
_STEP = 1e-6
"""Of the finite differences [rad]."""
_TOLERANCE = 1e-8


@cache
def posture_table(spec: RobotSpec) -> Array:
    """Canonical offsets from the default pose at every node, shape (heights, pitches, 3) [rad].

    At each node the base is at the commanded height and pitch, both soles are as flat as in the default pose and the
    centre of mass is as far ahead of them. Where joint limits forbid it, the nearest pose they allow.
    """
    legs = _Legs(spec)
    table = np.zeros((len(HEIGHTS), len(PITCHES), len(PITCH_JOINTS)))
    upright = int(np.argmin(np.abs(PITCHES)))
    for row in reversed(range(len(HEIGHTS))):  # from the default pose outwards, each from its neighbour's solution
        start = table[min(row + 1, len(HEIGHTS) - 1), upright]
        for columns in (range(upright, len(PITCHES)), range(upright, -1, -1)):
            bend = start
            for column in columns:
                bend = table[row, column] = legs.solve(HEIGHTS[row], PITCHES[column], bend)
    return table


def joint_offsets(spec: RobotSpec) -> Array:
    """:func:`posture_table` spread over the joints in native order, still canonical, (heights, pitches, n) [rad]."""
    table = posture_table(spec)
    slots = np.zeros((*table.shape[:2], NUM_SLOTS))
    slots[..., np.array(POSTURE_SLOTS)] = table[:, :, None, :]
    return slots[..., spec.slots]


@cache
def leg_length(spec: RobotSpec) -> float:
    """From the axis of hip pitch over those of knee and ankle pitch down to the sole, seen from the side [m]."""
    model = pinocchio_model(spec)
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, pinocchio.neutral(model))
    names = [spec.joint_names[spec.slots.tolist().index(slot)] for slot in POSTURE_SLOTS[0]]
    hip, knee, ankle = (data.oMi[model.getJointId(name)].translation for name in names)
    foot = data.oMf[model.getFrameId(spec.link_roles["left_foot"], pinocchio.FrameType.BODY)]
    thigh, shank = (float(np.hypot(*(upper - lower)[[0, 2]])) for upper, lower in ((hip, knee), (knee, ankle)))
    return thigh + shank + float(ankle[2] - foot.act(spec.sole_offsets[0])[2])


def _weighed(missing: Array) -> Array:
    """What a pose lacks of tilt [rad], height and balance [m], as the solver counts it, shape (3,)."""
    steep = np.array([1.0, 1.0, 1.0 + (missing[2] / _BALANCE_MARGIN) ** 2])
    return _WEIGHTS * missing * steep


class _Legs:
    """Kinematics of a robot whose legs bend together."""

    def __init__(self, spec: RobotSpec) -> None:
        self._model = pinocchio_model(spec)
        self._data = self._model.createData()
        self._spec = spec
        joints = spec.slots.tolist()
        self._index = np.array([[joints.index(slot) for slot in side] for side in POSTURE_SLOTS])
        self._columns = np.array([self._model.joints[self._model.getJointId(n)].idx_q for n in spec.joint_names])
        self._feet = [
            self._model.getFrameId(spec.link_roles[f"{side}_foot"], pinocchio.FrameType.BODY) for side in FEET
        ]
        signs, centre = spec.signs[self._index[0]], spec.default_joint_pos[self._index[0]]
        ends = signs * (np.stack([spec.joint_lower, spec.joint_upper])[:, self._index[0]] - centre)
        self._lower, self._upper = ends.min(axis=0), ends.max(axis=0)
        self._rest = self.measure(0.0, np.zeros(3))

    def measure(self, pitch: float, bend: Array) -> Array:
        """Tilt of the soles [rad], height of the base above them and centre of mass ahead of them [m], shape (3,)."""
        joints = self._spec.default_joint_pos.copy()
        joints[self._index] += self._spec.signs[self._index] * bend
        q = pinocchio.neutral(self._model)
        q[3:7] = (0.0, np.sin(pitch / 2), 0.0, np.cos(pitch / 2))
        q[self._columns] = joints
        pinocchio.framesForwardKinematics(self._model, self._data, q)
        centre = pinocchio.centerOfMass(self._model, self._data, q)
        poses = [self._data.oMf[foot] for foot in self._feet]
        soles = [pose.act(sole) for pose, sole in zip(poses, self._spec.sole_offsets, strict=True)]
        tilt = np.mean([np.arctan2(-pose.rotation[2, 0], pose.rotation[0, 0]) for pose in poses])
        ahead, height = centre[0] - np.mean([s[0] for s in soles]), -np.mean([s[2] for s in soles])
        return np.array([tilt, height, ahead])

    def solve(self, height: float, pitch: float, start: Array) -> Array:
        """Canonical offsets (3,) for a height offset [m] and a pitch [rad]: Levenberg-Marquardt inside the limits."""
        wanted = self._rest + np.array([0.0, height, 0.0])
        bend, damping = start, 1e-3
        missing = _weighed(wanted - self.measure(pitch, bend))
        for _ in range(_ITERATIONS):
            if np.abs(missing).max() < _TOLERANCE:
                break
            moved = [self.measure(pitch, bend + d) for d in _STEP * np.eye(3)]
            jacobian = (np.stack([_weighed(wanted - m) for m in moved], axis=1) - missing[:, None]) / -_STEP
            downhill = jacobian.T @ missing
            held = ((bend <= self._lower) & (downhill < 0)) | ((bend >= self._upper) & (downhill > 0))
            jacobian, downhill = np.where(held, 0.0, jacobian), np.where(held, 0.0, downhill)
            step = np.linalg.solve(jacobian.T @ jacobian + damping * np.eye(3), downhill)
            trial = np.clip(bend + step, self._lower, self._upper)
            left = _weighed(wanted - self.measure(pitch, trial))
            if left @ left < missing @ missing:
                bend, missing, damping = trial, left, damping * 0.1
            else:
                damping *= 10.0
        return bend
