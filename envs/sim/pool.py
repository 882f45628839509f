"""Several robots' simulations as one pool: every robot's state is written once into shared rows in slot space."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from eagle_rl.machine import usable_cores
from eagle_rl.threads import Threads

from ..pooling import share
from ..robots.spec import Array, RobotSpec
from .batch import Ids, RobotBatch
from .health import CAUSES, FlightRecorder, diagnose
from .staging import Staging

BATCHES_PER_THREAD = 4
"""So many parts is the pool cut into for each thread, so that none is long alone with the last."""
MIN_BATCH = 4
"""Fewest simulations of a part of a robot's; what comes with a batch outweighs the physics of fewer."""

Simulated = tuple[RobotSpec, mujoco.MjModel, int]
"""A robot, its compiled model and the number of its environments."""


class PhysicsPool:
    """Steps every robot and gathers their states into one array, copied to the learner's device once per step.

    A robot's simulations are shared out among batches, which threads step side by side. Simulations have nothing in
    common, so results do not depend on the number of threads; what is saved is sorted by robots and does not either.
    """

    def __init__(
        self,
        robots: Sequence[Simulated],
        decimation: int,
        device: torch.device,
        dtype: torch.dtype,
        num_threads: int = 1,
    ) -> None:
        """Lay out the rows, robots one after another.

        Args:
            robots: what is simulated.
            decimation: physics steps per control step.
            device: the learner's.
            dtype: of the staging array.
            num_threads: physics threads, 0 for one per core.
        """
        self.threads = Threads(num_threads or usable_cores(), "physics")
        """What steps the batches: MuJoCo does so without the interpreter's lock."""
        parts = _parts_of_a_robot(self.threads.count, len(robots))
        self._of_robots = [_share_out(robot, decimation, parts) for robot in robots]
        self.batches = [batch for batches in self._of_robots for batch in batches]
        """What is stepped as one, in the order of the rows; one batch a robot where there is one thread."""
        self._edges = np.cumsum([0, *(batch.num_envs for batch in self.batches)])
        self.rows = [slice(start, stop) for start, stop in pairwise(self._edges.tolist())]
        """Rows of each batch."""
        self.num_envs = int(self._edges[-1])
        self.device = device
        self.fault_folder: Path | None = None
        """Where the last states of sick environments are kept; None keeps none."""
        self._layout = Staging(self.batches)
        self.columns = self._layout.columns
        self._recorder = FlightRecorder(self.num_envs, self._layout.width)
        self._causes = np.zeros(self.num_envs, dtype=np.int64)
        width = self.columns["sensors"].stop
        self._staging = torch.zeros(self.num_envs, width, dtype=dtype, pin_memory=device.type == "cuda")
        self._array = self._staging.numpy()
        self._read()
        self._array[:] = self._layout.rows(self._recorder.latest)

    def step(self, targets: Tensor, wrench: Tensor | None = None) -> Tensor:
        """Advance one control step.

        Args:
            targets: canonical PD targets in slots [rad], shape (N, 32); NaN where the action was absurd.
            wrench: world-frame force [N] and torque [N m] on the bases, shape (N, 6), or None for none.

        Returns:
            The staging array on the learner's device, see :func:`staging_columns`, shape (N, columns); fresh. Rows of
            sick environments stay as they were in the step before, so that nothing that is not finite gets out.
        """
        native = self._layout.native_targets(targets.to("cpu", torch.float64).numpy())
        forces = None if wrench is None else wrench.to("cpu", torch.float64).numpy()
        wild = ~np.isfinite(native.sum(axis=1))
        aimed = ~wild[:, None]
        before, after = self._recorder.latest, self._recorder.next()

        def advance(part: int) -> None:
            batch, rows = self.batches[part], self.rows[part]
            if forces is not None:
                batch.apply_base_wrench(forces[rows])
            batch.step(native[rows, : batch.spec.num_joints], aimed[rows])
            batch.read(after[rows])

        self.threads.share_out(advance, range(len(self.batches)))
        self._stage(before, after, wild)
        if self.fault_folder is not None and self._causes.any():
            self._keep_faults(self.fault_folder)
        return self.staged()

    def staged(self) -> Tensor:
        """A fresh copy of the staging array on the learner's device."""
        if self.device.type == "cpu":
            return self._staging.clone()
        return self._staging.to(self.device, non_blocking=True)

    def split(self, ids: Tensor) -> list[tuple[int, Ids, Ids]]:
        """Split sorted pool rows by batch: (batch's index, rows local to it, positions in ``ids``)."""
        rows = ids.cpu().numpy()
        cuts = np.searchsorted(rows, self._edges)
        return [
            (part, rows[start:stop] - self._edges[part], np.arange(start, stop))
            for part, (start, stop) in enumerate(pairwise(cuts))
            if stop > start
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
        for part, local, at in self.split(ids):
            batch = self.batches[part]
            spec = batch.spec
            qpos = np.concatenate([root_[at, :7], spec.to_native(pos[at])], axis=1)
            qvel = np.concatenate([root_[at, 7:], spec.signs * vel[at][:, spec.slots]], axis=1)
            batch.reset(local, qpos, qvel)
            batch.read(self._recorder.latest[self.rows[part]], local)
        rows = ids.cpu().numpy()
        self._recorder.forget(rows)
        self._array[rows] = self._layout.rows(self._recorder.latest, rows)
        return self._staging[ids.cpu()].to(self.device)

    def push(self, ids: Tensor, lin_vel_w: Tensor, ang_vel_b: Tensor) -> None:
        """Add velocity to the bases of some environments before the next step, shape (n, 3) each."""
        linear, angular = (x.to("cpu", torch.float64).numpy() for x in (lin_vel_w, ang_vel_b))
        for part, local, at in self.split(ids):
            self.batches[part].push(local, linear[at], angular[at])

    def set_base_damping(self, damping: Tensor) -> None:
        """Set the damping of every base's rotation [N m s/rad], shape (N,)."""
        values = damping.to("cpu", torch.float64).numpy()
        for batch, rows in zip(self.batches, self.rows, strict=True):
            batch.set_base_damping(values[rows])

    def set_friction(self, ids: Tensor, friction: Tensor) -> None:
        """Set the friction coefficient of the ground under some environments, shape (n,)."""
        values = friction.to("cpu", torch.float64).numpy()
        for part, local, at in self.split(ids):
            self.batches[part].set_friction(local, values[at])

    def scale_gains(self, ids: Tensor, stiffness: Tensor, damping: Tensor) -> None:
        """Set kp and kd of some environments to multiples of the robots' own, in slots, shape (n, 32) each."""
        kp, kd = (x.to("cpu", torch.float64).numpy() for x in (stiffness, damping))
        for part, local, at in self.split(ids):
            spec = self.batches[part].spec
            damping_ = spec.damping * kd[at][:, spec.slots]
            self.batches[part].set_gains(local, spec.stiffness * kp[at][:, spec.slots], damping_)
            self._layout.damping[self.rows[part]][local] = spec.to_slots(damping_)

    def causes(self) -> Tensor:
        """What went wrong with each environment in the last step, 0 for nothing, int64, shape (N,); see ``CAUSES``."""
        return torch.from_numpy(self._causes).to(self.device)

    def state_dict(self) -> dict[str, Any]:
        """Physics states, robot by robot, and the staging array, which holds what the last substep left behind."""
        return {
            "states": [
                torch.from_numpy(np.concatenate([batch.state() for batch in batches])) for batches in self._of_robots
            ],
            "staging": self._staging.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for batches, saved in zip(self._of_robots, state["states"], strict=True):
            for batch in batches:
                batch.set_state(saved[batch.first_env : batch.first_env + batch.num_envs].numpy())
        self._read()
        self._recorder.forget(slice(None))
        self._staging.copy_(state["staging"])

    def _stage(self, before: Array, after: Array, wild: NDArray[np.bool_]) -> None:
        """Judge what MuJoCo wrote in a step and write the staging rows of those who are well."""
        columns, rows = self.batches[0].columns, self._layout.rows(after)
        alarms = after[:, columns["status"].start : columns["warning"].stop]
        advanced = after[:, columns["time"].start] > before[:, columns["time"].start]
        self._causes = diagnose(rows, advanced, np.logical_or.reduce(alarms, axis=1), wild)
        if self._causes.any():
            sick = self._causes > 0
            rows[sick] = self._array[sick]
        self._array[:] = rows

    def _keep_faults(self, folder: Path) -> None:
        """Write down what led to the present sicknesses, a file for each."""
        for part, local, _ in self.split(torch.from_numpy(np.flatnonzero(self._causes))):
            for env, row in zip(local, self.rows[part].start + local, strict=True):
                cause = CAUSES[self._causes[row] - 1]
                self.batches[part].fault(env, cause, self._recorder.last(row)).save(folder)

    def _read(self) -> None:
        """Take what MuJoCo wrote last for the latest."""
        for batch, rows in zip(self.batches, self.rows, strict=True):
            batch.read(self._recorder.latest[rows])


def _parts_of_a_robot(num_threads: int, num_robots: int) -> int:
    """Batches among which each robot's simulations are shared out, if it has enough of them."""
    return 1 if num_threads == 1 else math.ceil(BATCHES_PER_THREAD * num_threads / num_robots)


def _share_out(robot: Simulated, decimation: int, parts: int) -> list[RobotBatch]:
    """A robot's simulations in at most so many batches."""
    spec, model, num_envs = robot
    counts = share(num_envs, max(1, min(parts, num_envs // MIN_BATCH)))
    return [
        RobotBatch(spec, model, count, decimation, first_env)
        for count, first_env in zip(counts, accumulate(counts, initial=0), strict=False)  # the last is the sum
    ]
