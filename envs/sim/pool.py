"""Several robots' batches as one pool: every robot's state is written once into shared rows in slot space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..robots.slots import NUM_SLOTS
from .batch import RobotBatch

_BLOCKS = {"root_pos": 3, "root_quat": 4, "root_lin_vel_w": 3, "base_ang_vel_b": 3}


def staging_columns(num_sensors: int) -> dict[str, slice]:
    """Columns of the staging array: root, joint position, velocity and torque in slots, then the sensors."""
    joints = dict.fromkeys(("joint_pos", "joint_vel", "joint_torque"), NUM_SLOTS)
    sizes = _BLOCKS | joints | {"sensors": num_sensors}
    edges = np.cumsum([0, *sizes.values()]).tolist()
    return {name: slice(edges[i], edges[i + 1]) for i, name in enumerate(sizes)}


class PhysicsPool:
    """Steps every robot and gathers their states into one array, copied to the learner's device once per step."""

    def __init__(
        self, batches: Sequence[RobotBatch], device: torch.device, dtype: torch.dtype, overlap: bool = False
    ) -> None:
        """Lay out the rows: robots one after another, in the order of ``batches``.

        With ``overlap`` two robots are under way at a time: while one's state is checked and gathered, or its last
        simulations are awaited, the other's physics has the cores. They share nothing, so the results are the same.
        """
        self.batches = list(batches)
        self._map: Callable[..., Any] = ThreadPoolExecutor(2, "physics").map if overlap else map
        edges = np.cumsum([0, *(batch.num_envs for batch in batches)]).tolist()
        self.rows = [slice(edges[i], edges[i + 1]) for i in range(len(batches))]
        self.fault_folder: Path | None = None
        """Where the last states of sick environments are kept; None keeps none."""
        self.num_envs = edges[-1]
        self.device = device
        self.columns = staging_columns(batches[0].sensordata.shape[1])
        width = self.columns["sensors"].stop
        self._staging = torch.zeros(self.num_envs, width, dtype=dtype, pin_memory=device.type == "cuda")
        self._array = self._staging.numpy()
        for robot in range(len(self.batches)):
            self._gather_rows(robot, slice(None))

    def step(self, targets: Tensor, wrench: Tensor | None = None) -> Tensor:
        """Advance one control step.

        Args:
            targets: canonical PD targets in slots [rad], shape (N, 32); NaN where the action was absurd.
            wrench: world-frame force [N] and torque [N m] on the bases, shape (N, 6), or None for none.

        Returns:
            The staging array on the learner's device, see :func:`staging_columns`, shape (N, columns); fresh. Rows of
            sick environments stay as they were in the step before, so that nothing that is not finite gets out.
        """
        canonical = targets.to("cpu", torch.float64).numpy()
        forces = None if wrench is None else wrench.to("cpu", torch.float64).numpy()

        def advance(robot: int) -> None:
            batch, rows = self.batches[robot], self.rows[robot]
            if forces is not None:
                batch.apply_base_wrench(forces[rows])
            batch.step(batch.spec.to_native(canonical[rows]))
            self._gather_rows(robot, np.flatnonzero(batch.causes == 0) if batch.causes.any() else slice(None))

        list(self._map(advance, range(len(self.batches))))
        if self.fault_folder is not None:
            for batch in self.batches:
                for env in batch.causes.nonzero()[0].tolist():
                    batch.fault(env).save(self.fault_folder)
        return self.staged()

    def staged(self) -> Tensor:
        """A fresh copy of the staging array on the learner's device."""
        if self.device.type == "cpu":
            return self._staging.clone()
        return self._staging.to(self.device, non_blocking=True)

    def split(self, ids: Tensor) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Split sorted pool rows by robot: (robot index, rows local to its batch, positions in ``ids``)."""
        rows = ids.cpu().numpy()
        edges = [rows_.start for rows_ in self.rows] + [self.num_envs]
        cuts = np.searchsorted(rows, edges)
        return [
            (robot, rows[cuts[robot] : cuts[robot + 1]] - edges[robot], np.arange(cuts[robot], cuts[robot + 1]))
            for robot in range(len(self.batches))
            if cuts[robot + 1] > cuts[robot]
        ]

    def reset(self, ids: Tensor, root: Tensor, joint_pos: Tensor, joint_vel: Tensor) -> Tensor:
        """Write states and return the new staging rows.

        Args:
            ids: sorted pool rows, shape (n,).
            root: position, quaternion, world linear velocity, base angular velocity, shape (n, 13).
            joint_pos: canonical [rad], shape (n, 32).
            joint_vel: canonical [rad/s], shape (n, 32).
        """
        root_, pos, vel = (x.to("cpu", torch.float64).numpy() for x in (root, joint_pos, joint_vel))
        for robot, local, at in self.split(ids):
            batch = self.batches[robot]
            spec = batch.spec
            qpos = np.concatenate([root_[at, :7], spec.to_native(pos[at])], axis=1)
            qvel = np.concatenate([root_[at, 7:], spec.signs * vel[at][:, spec.slots]], axis=1)
            batch.reset(local, qpos, qvel)
            self._gather_rows(robot, local)
        return self._staging[ids.cpu()].to(self.device)

    def push(self, ids: Tensor, lin_vel_w: Tensor, ang_vel_b: Tensor) -> None:
        """Add velocity to the bases of some environments before the next step, shape (n, 3) each."""
        linear, angular = (x.to("cpu", torch.float64).numpy() for x in (lin_vel_w, ang_vel_b))
        for robot, local, at in self.split(ids):
            self.batches[robot].push(local, linear[at], angular[at])

    def set_base_damping(self, damping: Tensor) -> None:
        """Set the damping of every base's rotation [N m s/rad], shape (N,)."""
        values = damping.to("cpu", torch.float64).numpy()
        for batch, rows in zip(self.batches, self.rows, strict=True):
            batch.set_base_damping(values[rows])

    def causes(self) -> Tensor:
        """What went wrong with each environment in the last step, 0 for nothing, int64, shape (N,); see ``CAUSES``."""
        return torch.from_numpy(np.concatenate([batch.causes for batch in self.batches])).to(self.device)

    def state_dict(self) -> dict[str, Any]:
        """Physics states and the staging array, which holds what the last substep left behind."""
        return {
            "states": [torch.from_numpy(batch.state()) for batch in self.batches],
            "staging": self._staging.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for batch, saved in zip(self.batches, state["states"], strict=True):
            batch.set_state(saved.numpy())
        self._staging.copy_(state["staging"])

    def _gather_rows(self, robot: int, local: slice | np.ndarray) -> None:
        """Write the staging rows of some simulations of one robot."""
        batch, spec = self.batches[robot], self.batches[robot].spec
        block, columns = self._array[self.rows[robot]], self.columns
        rows = local if isinstance(local, slice) else local[:, None]
        block[local, 0:7] = batch.qpos[local, :7]
        block[local, 7:13] = batch.qvel[local, :6]
        block[rows, columns["joint_pos"].start + spec.slots] = spec.signs * (batch.qpos[local, 7:] - spec.zero_offsets)
        block[rows, columns["joint_vel"].start + spec.slots] = spec.signs * batch.qvel[local, 6:]
        block[rows, columns["joint_torque"].start + spec.slots] = spec.signs * batch.joint_torque[local]
        block[local, columns["sensors"]] = batch.sensordata[local]
