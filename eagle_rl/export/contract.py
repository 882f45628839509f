"""What a program must know to drive a robot with an exported policy; travels inside the ONNX file as JSON.

Canonical angles are ``sign * (q - zero_offset)``; slot arrays hold zero where a robot has no joint. One control step:

1. Frame: the terms of ``frame`` side by side, times their scales, bounded by ``observation_clip``.
2. ``history``: the last ``history_length`` frames, newest first; filled with the first frame at the start.
3. ``command``: (v_x, v_y, omega, height offset, pitch) times its scale. ``clock``: sin(2 pi phase) of the left and
   the right foot; the right foot's phase starts at 0 and gains ``gait_frequency * step_dt`` a step, the left one is
   ahead by ``gait_phase_offset``; both are ``standing_phase`` while the three velocity commands are zero. Where
   ``clock_harmonics`` is not 0, cos(2 pi phase) of both feet follows, then sine and cosine of each multiple up to it.
4. ``slot_mask``: 1 in the robot's slots.
5. PD targets: resting pose + ``action_scale`` * action, both canonical; actions bounded by ``action_clip``. The
   resting pose is the default one or, where there is a ``posture``, that plus ``posture_offsets``, interpolated
   linearly between its nodes at ``posture.share`` of a height and pitch that follow the command: each step
   ``1 - posture.left_over`` of the way, from zero at the start. Beyond the ends the last node holds.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import Any

from eagle_rl.errors import CheckpointError

FORMAT = 5
METADATA_KEY = "eagle.contract"
"""Entry of the ONNX file's metadata that holds the contract."""
DIGEST_KEY = "eagle.contract.sha256"

Numbers = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Term:
    """Adjacent columns of an observation."""

    name: str
    unit: str
    scale: Numbers
    """Factor of each column."""


@dataclass(frozen=True, kw_only=True)
class RobotContract:
    """One robot; arrays are in the order of ``joints``, angles native [rad]."""

    joints: tuple[str, ...]
    slots: tuple[int, ...]
    signs: Numbers
    zero_offsets: Numbers
    default_joint_pos: Numbers
    action_scale: Numbers
    """Canonical radians of PD target per unit action."""
    stiffness: Numbers
    """kp [N m/rad]."""
    damping: Numbers
    """kd [N m s/rad]."""
    effort_limit: Numbers
    """Bound on kp * error [N m]."""
    nominal_height: float
    """Base height at height command zero [m]."""
    gait_frequency: float
    """[Hz]"""
    posture_offsets: Numbers
    """Canonical offsets [rad] at the nodes of ``posture``: height, pitch, joint, the last changing fastest; empty where
    the resting pose is the default pose."""


@dataclass(frozen=True, kw_only=True)
class Posture:
    """How the resting pose follows the commanded height and pitch."""

    heights: Numbers
    """Nodes, evenly spaced [m]."""
    pitches: Numbers
    """Nodes, evenly spaced [rad]."""
    share: float
    """Of the commanded height and pitch that the pose takes over [-]."""
    left_over: float
    """Share of the way to the command that is left after a control step [-]."""


@dataclass(frozen=True, kw_only=True)
class Contract:
    """Everything between a robot's sensors and its PD targets, but the network."""

    version: str
    """Version of eagle that wrote it."""
    checkpoint: str
    """sha256 of the checkpoint it came from."""
    step_dt: float
    """[s]"""
    slots: tuple[str, ...]
    """Name of each slot."""
    history_length: int
    frame: tuple[Term, ...]
    command: Term
    observation_clip: float
    action_clip: float
    gait_phase_offset: float
    """[cycles]"""
    standing_phase: float
    """[cycles]"""
    clock_harmonics: int
    """Highest multiple of the gait's frequency in the clock; 0 for the sine alone."""
    posture: Posture | None
    """None where the resting pose is the default pose."""
    robots: dict[str, RobotContract]

    def to_json(self) -> str:
        """The one spelling of the contract."""
        return json.dumps({"format": FORMAT} | asdict(self), sort_keys=True)

    @property
    def digest(self) -> str:
        """sha256 of the contract."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()

    @classmethod
    def from_json(cls, text: str, source: str) -> Contract:
        """Read a contract.

        Args:
            text: what :meth:`to_json` wrote.
            source: where it comes from, for messages.

        Raises:
            CheckpointError: it is damaged or of another format.
        """
        try:
            values = json.loads(text)
            found = values.pop("format")
            if found != FORMAT:
                raise CheckpointError(f"{source}: contract of format {found}, expected {FORMAT}. Export it again.")
            robots = {name: RobotContract(**_tuples(robot)) for name, robot in values.pop("robots").items()}
            frame = tuple(Term(**_tuples(term)) for term in values.pop("frame"))
            command = Term(**_tuples(values.pop("command")))
            nodes = values.pop("posture")
            posture = None if nodes is None else Posture(**_tuples(nodes))
            return cls(robots=robots, frame=frame, command=command, posture=posture, **_tuples(values))
        except CheckpointError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise CheckpointError(f"{source}: its contract is damaged ({error}). Export the policy again.") from error


def _tuples(values: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
