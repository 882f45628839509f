"""Between what MuJoCo writes, native and robot by robot, and what the task reads, canonical and in slots.

Every environment has its robot's signs, offsets and columns: a few operations on whole tensors serve all robots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..robots.slots import NUM_SLOTS
from .batch import RobotBatch
from .columns import JOINT_BLOCKS, staging_columns
from .health import limits


@dataclass
class Conventions:
    """How each robot counts, measures and orders. What is said of targets is in double precision, as physics is."""

    robot: Tensor
    """Of each environment, an index into what follows, int64, shape (N,)."""
    source: Tensor
    """Columns of native rows that hold the base's velocities, then positions, velocities and forces of the joints in
    slots, int64, shape (R, 6 + 3 * 32)."""
    signs: Tensor
    """Of canonical angles, shape (R, 32); zero in absent slots."""
    zero_offsets: Tensor
    """Native angles where canonical ones are zero [rad], shape (R, 32)."""
    target_slots: Tensor
    """Slots of native targets, int64, shape (R, most joints)."""
    target_signs: Tensor
    """Shape (R, most joints)."""
    target_offsets: Tensor
    """[rad], shape (R, most joints)."""
    largest: Tensor
    """Magnitude of each native number of a simulation that is well, shape (R, width)."""
    beyond: Tensor
    """Code of what is wrong where it is larger, see ``envs.sim.health.limits``, shape (R, width)."""


class Staging:
    """Turns native rows, see ``RobotBatch.columns``, into staging rows."""

    def __init__(self, batches: Sequence[RobotBatch], dtype: torch.dtype) -> None:
        """Take the columns of ``batches``; native and staging rows are of type ``dtype``."""
        self._dtype = dtype
        self.columns = staging_columns(batches[0].sensordata.shape[1])
        self.width = max(batch.width for batch in batches) + 1
        """Of native rows: as many columns as the widest robot has, and one of zeros, which absent slots show."""
        self.judged = max(batch.columns["ctrl"].start for batch in batches)
        """So many columns of native rows are judged; targets, which come last, are kept for fault files alone."""
        shared = batches[0].columns
        self.time = shared["time"].start
        """Native column of the clock [s]."""
        self._sensors = shared["sensordata"]
        self._root = slice(shared["qpos"].start, shared["qpos"].start + 7)

    def conventions(self, of_robots: Sequence[Sequence[RobotBatch]], device: torch.device) -> Conventions:
        """Those of some robots, whose batches' environments lie one after another."""
        counts = torch.tensor([sum(batch.num_envs for batch in batches) for batches in of_robots])
        firsts = [batches[0] for batches in of_robots]
        most = max(batch.spec.num_joints for batch in firsts)
        judged = [limits(batch.columns, self.judged, torch.finfo(self._dtype).max) for batch in firsts]

        def of_each(of: Callable[[RobotBatch], NDArray[Any]]) -> Tensor:
            return torch.from_numpy(np.stack([of(batch) for batch in firsts])).to(device)

        def padded(x: NDArray[Any], mode: Any = "constant") -> NDArray[Any]:
            return np.pad(x, (0, most - len(x)), mode)

        return Conventions(
            robot=torch.arange(len(counts)).repeat_interleave(counts).to(device),
            source=of_each(self._source),
            signs=of_each(lambda batch: batch.spec.to_slots(batch.spec.signs)).to(self._dtype),
            zero_offsets=of_each(lambda batch: batch.spec.to_slots(batch.spec.zero_offsets)).to(self._dtype),
            target_slots=of_each(lambda batch: padded(batch.spec.slots, "edge")),
            target_signs=of_each(lambda batch: padded(batch.spec.signs)),
            target_offsets=of_each(lambda batch: padded(batch.spec.zero_offsets)),
            largest=torch.from_numpy(np.stack([largest for largest, _ in judged])).to(device, self._dtype),
            beyond=torch.from_numpy(np.stack([beyond for _, beyond in judged])).to(device, self._dtype),
        )

    def blocks(self, native: Tensor, damping: Tensor, robot: Tensor, conventions: Conventions) -> list[Tensor]:
        """Staging rows, shape (n, columns), as blocks of columns to be laid side by side.

        The torque is that of the last physics step: clipped kp * error minus kd * velocity [N m].

        Args:
            native: native rows, shape (n, ``width``).
            damping: kd in force, in slots [N m s/rad], shape (n, 32).
            robot: index of each one's robot, shape (n,).
            conventions: of the robots.
        """
        moved = native.gather(1, conventions.source[robot])
        moving, *joints = moved.split([6, *([NUM_SLOTS] * len(JOINT_BLOCKS))], dim=1)
        position, velocity, force = joints
        canonical = (position - conventions.zero_offsets[robot], velocity, force - damping * velocity)
        in_slots = [conventions.signs[robot] * x for x in canonical]
        return [native[:, self._root], moving, *in_slots, native[:, self._sensors]]

    def _source(self, batch: RobotBatch) -> NDArray[np.int64]:
        """A row of ``Conventions.source``."""
        columns = {name: np.arange(block.start, block.stop) for name, block in batch.columns.items()}

        def in_slots(joints: NDArray[np.int64]) -> NDArray[np.int64]:
            slots = np.full(NUM_SLOTS, self.width - 1)
            slots[batch.spec.slots] = joints
            return slots

        joints = (columns["qpos"][7:], columns["qvel"][6:], columns["actuator_force"])
        return np.concatenate([columns["qvel"][:6], *map(in_slots, joints)])


def native_targets(canonical: Tensor, conventions: Conventions) -> Tensor:
    """Targets in slots [rad], shape (N, 32), as native ones in double precision, shape (N, most joints).

    What is beyond a robot's joints means nothing, and is finite if its targets are.
    """
    robot = conventions.robot
    chosen = canonical.double().gather(1, conventions.target_slots[robot])
    return conventions.target_signs[robot] * chosen + conventions.target_offsets[robot]
