"""Run an exported policy with numpy and onnxruntime alone: raw sensor readings in, PD targets out.

Nothing here imports torch, MuJoCo or the task; everything comes from the contract in the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

from eagle_rl.errors import CheckpointError, RobotError, did_you_mean
from eagle_rl.paths import misplaced

from .contract import DIGEST_KEY, METADATA_KEY, Contract

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """What the sensors of one robot say. Joint arrays are in the contract's order of joints."""

    base_quat: Array
    """Orientation of the base (w, x, y, z), shape (4,)."""
    base_ang_vel: Array
    """Angular velocity in the base frame [rad/s], shape (3,)."""
    joint_pos: Array
    """[rad], shape (n,)."""
    joint_vel: Array
    """[rad/s], shape (n,)."""


def load_session(path: Path) -> tuple[onnxruntime.InferenceSession, Contract]:
    """Open an exported policy and check its contract.

    Raises:
        CheckpointError: the file is missing, damaged, or was not exported by us.
    """
    if not path.is_file():
        raise CheckpointError(misplaced(path, "a folder, expected a file that `eagle export` wrote.", "*.onnx"))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        reason = str(error).splitlines()[0].split(" : ")[-1]  # after onnxruntime's own codes
        raise CheckpointError(f"{path}: cannot be opened as ONNX: {reason} Make one: eagle export CKPT.") from error
    metadata = session.get_modelmeta().custom_metadata_map
    if METADATA_KEY not in metadata:
        raise CheckpointError(f"{path}: holds no contract, so it does not come from `eagle export`.")
    contract = Contract.from_json(metadata[METADATA_KEY], str(path))
    if contract.digest != metadata.get(DIGEST_KEY):
        raise CheckpointError(f"{path}: its contract does not match its own sha256. Export the policy again.")
    return session, contract


class OnnxPolicy:
    """A policy driving one robot.

    Attributes:
        contract: what the file promises.
        robot: the contract's entry of the robot.
        action: the last action in slots, shape (32,).
    """

    def __init__(self, path: Path, robot: str) -> None:
        """Open the file for a robot.

        Raises:
            CheckpointError: the file cannot be used.
            RobotError: it has no such robot.
        """
        self._session, self.contract = load_session(path)
        known = self.contract.robots
        if robot not in known:
            raise RobotError(
                f"{path}: no robot {robot!r} in it.{did_you_mean(robot, known)} It has: {', '.join(known)}."
            )
        self.robot = known[robot]
        self._slots = np.array(self.robot.slots)
        self._mask = np.zeros(len(self.contract.slots))
        self._mask[self._slots] = 1.0
        self._signs, self._default, self._action_scale = (
            np.array(x) for x in (self.robot.signs, self.robot.default_joint_pos, self.robot.action_scale)
        )
        self._posture_offsets = np.array(self.robot.posture_offsets).reshape(-1, len(self._slots))
        self.reset()

    def reset(self) -> None:
        """Begin anew: no history, no last action, gait phase zero."""
        self.action = np.zeros_like(self._mask)
        self._phase = 0.0
        self._followed = np.zeros(2)
        self._frames: Array | None = None

    def step(self, reading: Reading, command: ArrayLike) -> Array:
        """Choose the next PD targets; call once per ``contract.step_dt``.

        Args:
            reading: the robot's sensors now.
            command: (v_x, v_y, omega, height offset, pitch) [m/s, m/s, rad/s, m, rad].

        Returns:
            PD targets [rad] in the contract's order of joints, shape (n,).
        """
        command = np.asarray(command, dtype=np.float64)
        inputs = self.observe(reading, command)
        (actions,) = self._session.run(["actions"], {k: v[None].astype(np.float32) for k, v in inputs.items()})
        bound = self.contract.action_clip
        self.action = np.clip(actions[0].astype(np.float64), -bound, bound) * self._mask
        self._phase = (self._phase + self.robot.gait_frequency * self.contract.step_dt) % 1.0
        return self._default + self._signs * (self._bend(command) + self._action_scale * self.action[self._slots])

    def _bend(self, command: Array) -> Array:
        """Offset of the resting pose from the default pose, canonical, shape (n,)."""
        posture = self.contract.posture
        if posture is None:
            return np.zeros_like(self._default)
        self._followed = command[3:] + posture.left_over * (self._followed - command[3:])
        height, pitch = posture.share * self._followed
        heights, pitches = hat_weights(height, np.array(posture.heights)), hat_weights(pitch, np.array(posture.pitches))
        return np.asarray(np.outer(heights, pitches).ravel() @ self._posture_offsets)

    def observe(self, reading: Reading, command: Array) -> dict[str, Array]:
        """Inputs of the network; pushes the reading into the history."""
        frame = self._frame(reading)
        if self._frames is None:
            self._frames = np.tile(frame, (self.contract.history_length, 1))
        else:
            self._frames = np.vstack([frame, self._frames[:-1]])
        bound = self.contract.observation_clip
        return {
            "history": self._frames.ravel(),
            "command": np.clip(np.array(self.contract.command.scale) * command, -bound, bound),
            "clock": self._clock(command),
            "slot_mask": self._mask,
        }

    def _frame(self, reading: Reading) -> Array:
        """Scaled proprioception, one control step of it."""
        quantities = {
            "base_ang_vel": reading.base_ang_vel,
            "projected_gravity": projected_gravity(reading.base_quat),
            "joint_pos_rel": self._to_slots(self._signs * (reading.joint_pos - self._default)),
            "joint_vel": self._to_slots(self._signs * reading.joint_vel),
            "last_action": self.action,
        }
        columns = [np.array(term.scale) * quantities[term.name] for term in self.contract.frame]
        return np.clip(np.concatenate(columns), -self.contract.observation_clip, self.contract.observation_clip)

    def _to_slots(self, native: Array) -> Array:
        out = np.zeros_like(self._mask)
        out[self._slots] = native
        return out

    def _clock(self, command: Array) -> Array:
        standing = not command[:3].any()
        phases = np.array([self._phase + self.contract.gait_phase_offset, self._phase])
        return clock(np.full(2, self.contract.standing_phase) if standing else phases, self.contract.clock_harmonics)


def clock(phases: Array, harmonics: int) -> Array:
    """Gait clock of the feet's phases [cycles], shape (2,), see the contract; shape (2,) or (4 harmonics,)."""
    if not harmonics:
        return np.sin(2.0 * np.pi * phases)
    angles = 2.0 * np.pi * np.arange(1, harmonics + 1)[:, None] * phases
    return np.stack((np.sin(angles), np.cos(angles)), axis=1).ravel()


def projected_gravity(quat: Array) -> Array:
    """Direction of gravity in a frame of orientation (w, x, y, z), shape (3,)."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array([2.0 * (w * y - x * z), -2.0 * (w * x + y * z), 2.0 * (x * x + y * y) - 1.0])


def hat_weights(x: float, nodes: Array) -> Array:
    """Weights (n,) of linear interpolation between evenly spaced nodes (n,); beyond the ends the last one holds."""
    distance = np.abs(np.clip(x, nodes[0], nodes[-1]) - nodes) / (nodes[1] - nodes[0])
    return np.asarray(np.maximum(0.0, 1.0 - distance))
