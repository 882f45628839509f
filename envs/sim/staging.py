"""Between what MuJoCo writes, native and robot by robot, and what the task reads, canonical and in slots.

Every environment has its robot's signs, offsets and columns: a few operations on whole tensors serve all robots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import Self

from ..robots.slots import NUM_SLOTS
from .batch import RobotBatch
from .columns import JOINT_BLOCKS, staging_columns


@dataclass
class Conventions:
    """How each environment's robot counts, measures and orders. Angles are in double precision, as the physics is."""

    source: Tensor
    """Columns of native rows that hold the base's velocities, then positions, velocities and forces of the joints in
    slots, int64, shape (N, 6 + 3 * 32)."""
    signs: Tensor
    """Of canonical angles, shape (N, 32); zero in absent slots."""
    zero_offsets: Tensor
    """Native angles where canonical ones are zero [rad], shape (N, 32)."""
    damping: Tensor
    """kd in force [N m s/rad], shape (N, 32)."""
    target_slots: Tensor
    """Slots of native targets, int64, shape (N, most joints)."""
    target_signs: Tensor
    """Shape (N, most joints)."""
    target_offsets: Tensor
    """[rad], shape (N, most joints)."""

    def rows(self, ids: Tensor) -> Self:
        """Those of some environments."""
        return type(self)(**{f.name: getattr(self, f.name)[ids] for f in fields(self)})


class Staging:
    """Turns native rows, see ``RobotBatch.columns``, into staging rows, and canonical targets into native ones."""

    def __init__(self, batches: Sequence[RobotBatch]) -> None:
        """Take the columns of ``batches``."""
        self.columns = staging_columns(batches[0].sensordata.shape[1])
        self.width = max(batch.width for batch in batches) + 1
        """Of native rows: as many columns as the widest robot has, and one of zeros, which absent slots show."""
        shared = batches[0].columns
        self.alarms = slice(shared["status"].start, shared["warning"].stop)
        """Native columns in which MuJoCo warns of something, where they are not zero."""
        self.time = shared["time"].start
        """Native column of the clock [s]."""
        self._sensors = shared["sensordata"]
        self._root = slice(shared["qpos"].start, shared["qpos"].start + 7)

    def conventions(self, batches: Sequence[RobotBatch], device: torch.device) -> Conventions:
        """Those of the robots of ``batches``, whose environments lie one after another."""
        most = max(batch.spec.num_joints for batch in batches)

        def of_each(of: Callable[[RobotBatch], NDArray[Any]]) -> Tensor:
            """A row for each environment, which it shares with its robot's others."""
            rows = np.repeat([of(batch) for batch in batches], [batch.num_envs for batch in batches], axis=0)
            return torch.from_numpy(rows).to(device)

        def padded(x: NDArray[Any], mode: Any = "constant") -> NDArray[Any]:
            return np.pad(x, (0, most - len(x)), mode)

        return Conventions(
            source=of_each(self._source),
            signs=of_each(lambda batch: batch.spec.to_slots(batch.spec.signs)),
            zero_offsets=of_each(lambda batch: batch.spec.to_slots(batch.spec.zero_offsets)),
            damping=of_each(lambda batch: batch.spec.to_slots(batch.spec.damping)),
            target_slots=of_each(lambda batch: padded(batch.spec.slots, "edge")),
            target_signs=of_each(lambda batch: padded(batch.spec.signs)),
            target_offsets=of_each(lambda batch: padded(batch.spec.zero_offsets)),
        )

    def rows(self, native: Tensor, conventions: Conventions) -> Tensor:
        """Staging rows in double precision, shape (n, columns), from native rows, shape (n, ``width``).

        The torque is that of the last physics step: clipped kp * error minus kd * velocity [N m].
        """
        moving, *joints = native.gather(1, conventions.source).split([6, *([NUM_SLOTS] * len(JOINT_BLOCKS))], dim=1)
        position, velocity, force = joints
        canonical = (position - conventions.zero_offsets, velocity, force - conventions.damping * velocity)
        in_slots = [conventions.signs * x for x in canonical]
        return torch.cat((native[:, self._root], moving, *in_slots, native[:, self._sensors]), dim=1)

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
    chosen = canonical.double().gather(1, conventions.target_slots)
    return conventions.target_signs * chosen + conventions.target_offsets
