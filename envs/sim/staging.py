"""Between what MuJoCo writes, native and robot by robot, and what the task reads, canonical and in slots.

Every environment has its robot's signs, offsets and columns, so that a few operations on whole arrays serve all robots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..robots.slots import NUM_SLOTS
from ..robots.spec import Array
from .batch import Ids, RobotBatch
from .columns import JOINT_BLOCKS, staging_columns


class Staging:
    """Turns native rows, see ``RobotBatch.columns``, into staging rows, and canonical targets into native ones."""

    def __init__(self, batches: Sequence[RobotBatch]) -> None:
        """Take the conventions of the robots of ``batches``, whose environments lie one after another."""
        self.columns = staging_columns(batches[0].sensordata.shape[1])
        self.width = max(batch.width for batch in batches) + 1
        """Of native rows: as many columns as the widest robot has, and one of zeros, which absent slots show."""
        self._joints = slice(self.columns[JOINT_BLOCKS[0]].start, self.columns[JOINT_BLOCKS[-1]].stop)
        most = max(batch.spec.num_joints for batch in batches)

        def of_each(of: Callable[[RobotBatch], NDArray[Any]]) -> NDArray[Any]:
            """A row for each environment, which it shares with its robot's others."""
            return np.repeat([of(batch) for batch in batches], [batch.num_envs for batch in batches], axis=0)

        def padded(x: NDArray[Any], mode: Any = "constant") -> NDArray[Any]:
            return np.pad(x, (0, most - len(x)), mode)

        envs = np.arange(sum(batch.num_envs for batch in batches))[:, None]
        self._source = of_each(self._source_columns) + self.width * envs
        """Where each staging number lies among all native rows, shape (N, columns)."""
        self._signs = of_each(lambda batch: np.tile(batch.spec.to_slots(batch.spec.signs), len(JOINT_BLOCKS)))
        self._zero_offsets = of_each(lambda batch: batch.spec.to_slots(batch.spec.zero_offsets))
        self.damping: Array = of_each(lambda batch: batch.spec.to_slots(batch.spec.damping))
        """kd in slots [N m s/rad], shape (N, 32)."""
        self._target_slots = of_each(lambda batch: padded(batch.spec.slots, "edge")) + NUM_SLOTS * envs
        """Where each native target lies among all canonical ones, shape (N, most joints)."""
        self._target_signs = of_each(lambda batch: padded(batch.spec.signs))
        self._target_offsets = of_each(lambda batch: padded(batch.spec.zero_offsets))

    def native_targets(self, canonical: Array) -> Array:
        """Targets in slots [rad], shape (N, 32), as native ones, shape (N, most joints).

        What is beyond a robot's joints means nothing, and is finite if its targets are.
        """
        return self._target_signs * canonical.take(self._target_slots) + self._target_offsets

    def rows(self, native: Array, envs: Ids | slice = slice(None)) -> Array:
        """Staging rows of some environments in double precision, shape (n, columns), from all native rows (N, width).

        The torque is that of the last physics step: clipped kp * error minus kd * velocity [N m].
        """
        rows: Array = native.take(self._source[envs])
        with np.errstate(over="ignore", invalid="ignore"):  # in rows of the sick, which are left out later
            rows[:, self.columns["joint_pos"]] -= self._zero_offsets[envs]
            rows[:, self.columns["joint_torque"]] -= self.damping[envs] * rows[:, self.columns["joint_vel"]]
            rows[:, self._joints] *= self._signs[envs]
        return rows

    def _source_columns(self, batch: RobotBatch) -> NDArray[np.int64]:
        """Column of its native row that each staging number of a robot comes from, shape (columns,)."""
        columns = {name: np.arange(block.start, block.stop) for name, block in batch.columns.items()}

        def in_slots(joints: NDArray[np.int64]) -> NDArray[np.int64]:
            slots = np.full(NUM_SLOTS, self.width - 1)
            slots[batch.spec.slots] = joints
            return slots

        qpos, qvel = columns["qpos"], columns["qvel"]
        joints = [in_slots(x) for x in (qpos[7:], qvel[6:], columns["actuator_force"])]
        return np.concatenate([qpos[:7], qvel[:6], *joints, columns["sensordata"]])
