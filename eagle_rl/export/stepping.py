"""The resting pose of a contract with a ``posture``: legs that bend and step as commanded.

Each control step the pose moves ``1 - left_over`` of the way to the command, from zero at the start; the phases are
those of the feet at the end of the step. With the command so followed:

* height and pitch, times ``share``, are looked up in ``bends`` and ``strides``, interpolated linearly between the
  nodes; for the bend of a foot in swing the height is less by ``gait_share`` times ``swing_height`` times a quintic
  with its apex at mid-swing;
* the foot goes ahead, aside and round, at the commanded velocity times ``gait_share``, for a time that falls at unit
  rate through stance and comes back as a cosine in swing: these three times the ``strides`` are added to the bend.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .contract import Legs, Posture

Array = NDArray[np.float64]


class RestingLegs:
    """Offsets of one robot's joints from the default pose."""

    def __init__(self, posture: Posture, legs: Legs, num_joints: int) -> None:
        """Start in the default pose."""
        self._posture, self._legs = posture, legs
        self._nodes = np.array(posture.heights), np.array(posture.pitches)
        nodes = len(posture.heights) * len(posture.pitches)
        self._joints = np.array(legs.joints)
        self._bends = np.array(legs.bends).reshape(nodes, -1)
        self._strides = np.array(legs.strides).reshape(2, nodes, 3, -1)
        self._num_joints = num_joints
        self._followed = np.zeros(5)

    def advance(self, command: Array, foot_phase: Array, frequency: float) -> Array:
        """Offsets [rad] of this control step, canonical, shape (n,)."""
        posture = self._posture
        self._followed = command + posture.left_over * (self._followed - command)
        velocity = posture.gait_share * self._followed[:3]
        height, pitch = posture.share * self._followed[3:]
        offsets = np.zeros(self._num_joints)
        for foot, phase in enumerate(foot_phase):
            cycle = _homogenised(phase % 1.0, posture.stance_ratio)
            lift = posture.gait_share * self._legs.swing_height * _rise(cycle)
            time = posture.stance_ratio / frequency * _stride(cycle)
            strides = np.einsum("n,ndj->dj", self._weights(height, pitch), self._strides[foot])
            bend = self._weights(height - lift, pitch) @ self._bends
            offsets[self._joints[foot]] = bend + time * velocity @ strides
        return offsets

    def _weights(self, height: float, pitch: float) -> Array:
        """Weights of the nodes at a height and pitch, (nodes,)."""
        return np.outer(*(hat_weights(x, nodes) for x, nodes in zip((height, pitch), self._nodes, strict=True))).ravel()


def _homogenised(phase: float, stance_ratio: float) -> float:
    """Stretch a phase so that stance fills [0, 0.5)."""
    if phase < stance_ratio:
        return 0.5 * phase / stance_ratio
    return 0.5 + 0.5 * (phase - stance_ratio) / (1.0 - stance_ratio)


def _rise(cycle: float) -> float:
    rise = max(0.0, 1.0 - 4.0 * abs(cycle - 0.75))
    return rise**3 * (10.0 + rise * (6.0 * rise - 15.0))


def _stride(cycle: float) -> float:
    return 0.5 - 2.0 * cycle if cycle < 0.5 else 0.5 * float(np.cos(2.0 * np.pi * cycle))


def hat_weights(x: float, nodes: Array) -> Array:
    """Weights (n,) of linear interpolation between evenly spaced nodes (n,); beyond the ends the last one holds."""
    distance = np.abs(np.clip(x, nodes[0], nodes[-1]) - nodes) / (nodes[1] - nodes[0])
    return np.asarray(np.maximum(0.0, 1.0 - distance))
