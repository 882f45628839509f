"""Several robots' simulations as one pool: every robot's state is written once into shared rows in slot space.

A step has two parts: :meth:`PhysicsPool.advance`, which is physics, and :meth:`PhysicsPool.stage`, which is arithmetic
on tensors and may be part of a kernel (``envs.control_step``).
"""

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
from .staging import Staging, native_targets

BATCHES_PER_THREAD = 4
"""So many parts is the pool cut into for each thread, so that none is long alone with the last."""
MIN_BATCH = 4
"""Fewest simulations of a part of a robot's; what comes with a batch outweighs the physics of fewer."""

Simulated = tuple[RobotSpec, mujoco.MjModel, int]
"""A robot, its compiled model and the number of its environments."""


class PhysicsPool:
    """Steps every robot and gathers their states into one tensor, on the learner's device.

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
            dtype: of native and staging rows.
            num_threads: physics threads, 0 for one per core.
        """
        self.threads = Threads(num_threads or usable_cores(), "physics", _let_overflow)
        """What steps the batches: MuJoCo does so without the interpreter's lock."""
        parts = _parts_of_a_robot(self.threads.count, len(robots))
        self._of_robots = [_share_out(robot, decimation, parts) for robot in robots]
        self.batches = [batch for batches in self._of_robots for batch in batches]
        """What is stepped as one, in the order of the rows; one batch a robot where there is one thread."""
        self._edges = np.cumsum([0, *(batch.num_envs for batch in self.batches)])
        self.rows = [slice(start, stop) for start, stop in pairwise(self._edges.tolist())]
        """Rows of each batch."""
        self._targets = [(rows, slice(b.spec.num_joints)) for rows, b in zip(self.rows, self.batches, strict=True)]
        self.num_envs = int(self._edges[-1])
        self.device, self._on_cpu = device, device.type == "cpu"  # an idle call takes long after physics
        self.fault_folder: Path | None = None
        """Where the last states of sick environments are kept; None keeps none."""
        self._layout = Staging(self.batches, dtype)
        self.conventions = self._layout.conventions(self._of_robots, device)
        self.columns = self._layout.columns
        self._recorder = FlightRecorder(self.num_envs, self._layout.width, dtype, pin_memory=device.type == "cuda")
        self._readings = [
            [batch.readings(kept[rows]) for batch, rows in zip(self.batches, self.rows, strict=True)]
            for kept in self._recorder.all
        ]
        self._split: tuple[Tensor | None, list[tuple[int, Ids, Ids]]] = None, []
        self._read()
        self.native = self._latest()
        """What MuJoCo wrote in the last step, robot by robot, shape (N, columns of the widest); not in double
        precision, unless ``dtype`` is: no less is left of it than of what is staged, and it is half as much."""
        self.wild = torch.zeros(self.num_envs, dtype=torch.bool, device=device)
        """Whether the last action was absurd, shape (N,); see :meth:`aim`."""
        self.any_wild = self.wild.any()
        """Whether any was, bool, shape ()."""
        self.clock = torch.zeros(self.num_envs, dtype=dtype, device=device)
        """Of each simulation after the last step [s], shape (N,)."""
        self.causes = torch.zeros(self.num_envs, dtype=torch.long, device=device)
        """What went wrong with each environment in the last step, 0 for nothing, shape (N,); see ``CAUSES``."""
        damping = [np.tile(batch.spec.to_slots(batch.spec.damping), (batch.num_envs, 1)) for batch in self.batches]
        self.damping = torch.from_numpy(np.concatenate(damping)).to(device, dtype)
        """kd in force, in slots [N m s/rad], shape (N, 32)."""
        self.staged = torch.cat(self._blocks(self.native), dim=1)
        """Staging rows, see :func:`staging_columns`, shape (N, columns); a new tensor at each step. Rows of sick
        environments stay as they were in the step before, so that nothing that is not finite gets out."""
        self.staged_before = self.staged
        """The same one step earlier; as they are now where an episode has just begun."""

    def step(self, targets: Tensor, wrench: Tensor | None = None) -> Tensor:
        """Advance one control step.

        Args:
            targets: canonical PD targets in slots [rad], shape (N, 32); NaN where the action was absurd.
            wrench: world-frame force [N] and torque [N m] on the bases, shape (N, 6), or None for none.

        Returns:
            ``staged``.
        """
        self.advance(self.aim(targets), wrench)
        self.stage()
        return self.staged

    def aim(self, targets: Tensor) -> Tensor:
        """Canonical PD targets, see :meth:`step`, as native ones; remembers which of them are no numbers."""
        self.wild = ~targets.sum(dim=1).isfinite()
        self.any_wild = self.wild.any()
        return native_targets(targets, self.conventions)

    def advance(self, targets: Tensor, wrench: Tensor | None = None) -> None:
        """Nothing but physics, under what :meth:`aim` returned; :meth:`stage` follows."""
        native = self._array(targets)
        forces = None if wrench is None else self._array(wrench)
        aimed = ~self._array(self.wild)[:, None] if self.any_wild else None
        after = self._readings[self._recorder.next()]

        def advance(part: int) -> None:
            batch, rows = self.batches[part], self.rows[part]
            if forces is not None:
                batch.apply_base_wrench(forces[rows])
            batch.step(native[self._targets[part]], True if aimed is None else aimed[rows])
            for written, values in after[part]:
                written[:] = values

        with np.errstate(over="ignore"):
            self.threads.share_out(advance, range(len(self.batches)))
        self.native = self._latest()

    def stage(self) -> None:
        """Judge what MuJoCo wrote in a step, and stage the rows of those who are well."""
        judged, time = self.native[:, : self._layout.judged], self.native[:, self._layout.time]
        robot, of = self.conventions.robot, self.conventions
        self.causes = diagnose(judged, of.largest[robot], of.beyond[robot], time > self.clock, self.wild)
        self.clock = time.clone()
        blocks, sick = self._blocks(self.native), self.causes.unsqueeze(1) > 0
        before = self.staged.split([block.shape[1] for block in blocks], dim=1)
        self.staged_before = self.staged
        self.staged = torch.cat([torch.where(sick, *pair) for pair in zip(before, blocks, strict=True)], dim=1)

    def split(self, ids: Tensor) -> list[tuple[int, Ids, Ids]]:
        """Split sorted pool rows by batch: (batch's index, rows local to it, positions in ``ids``)."""
        if ids is not self._split[0]:  # a reset asks several times
            rows = ids.cpu().numpy()
            cuts = np.searchsorted(rows, self._edges)
            parts = [
                (part, rows[start:stop] - self._edges[part], np.arange(start, stop))
                for part, (start, stop) in enumerate(pairwise(cuts.tolist()))
                if stop > start
            ]
            self._split = ids, parts
        return self._split[1]

    def poses(self, ids: Tensor) -> list[Array]:
        """Native ``qpos`` of some environments, sorted pool rows, one each."""
        return [self.batches[part].qpos[env].copy() for part, local, _ in self.split(ids) for env in local]

    def place(self, ids: Tensor, root: Tensor, joint_pos: Tensor, joint_vel: Tensor) -> None:
        """Write states; :meth:`staging_rows` are what to :meth:`restage` then.

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
        self._recorder.forget(ids.cpu().numpy())
        if self.device.type != "cpu":  # else it is the same memory
            self.native[ids] = self._recorder.tensor[ids.cpu()].to(self.device)

    def staging_rows(self, ids: Tensor) -> Tensor:
        """Staging rows of some environments, shape (n,), by what MuJoCo wrote of them; nothing is written."""
        return torch.cat(self._blocks(self.native[ids], ids), dim=1)

    def restage(self, ids: Tensor, rows: Tensor) -> None:
        """Let these be the staging rows of some environments, shape (n,), whose episodes begin; written in place."""
        self.staged[ids] = rows
        self.staged_before = self.staged_before.index_copy(0, ids, rows)
        self.clock[ids] = 0.0

    def push(self, ids: Tensor, lin_vel_w: Tensor, ang_vel_b: Tensor) -> None:
        """Add velocity to the bases of some environments before the next step, shape (n, 3) each."""
        linear, angular = (x.to("cpu", torch.float64).numpy() for x in (lin_vel_w, ang_vel_b))
        for part, local, at in self.split(ids):
            self.batches[part].push(local, linear[at], angular[at])

    def release(self) -> None:
        """Let go of the bases, which the last wrench would otherwise hold until their episodes end."""
        for batch in self.batches:
            batch.apply_base_wrench(np.zeros(6))

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
            slots = torch.from_numpy(spec.to_slots(damping_)).to(self.damping)
            self.damping[ids[at[0] : at[-1] + 1]] = slots

    def state_dict(self) -> dict[str, Any]:
        """Physics states, robot by robot, and the staging rows, which hold what the last substep left behind."""
        return {
            "states": [
                torch.from_numpy(np.concatenate([batch.state() for batch in batches])) for batches in self._of_robots
            ],
            "staging": self.staged.cpu(),
            "staging_before": self.staged_before.cpu(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for batches, saved in zip(self._of_robots, state["states"], strict=True):
            for batch in batches:
                batch.set_state(saved[batch.first_env : batch.first_env + batch.num_envs].numpy())
        self._read()
        self._recorder.forget(slice(None))
        self.native = self._latest()
        self.clock = self.native[:, self._layout.time].clone()
        self.staged = state["staging"].to(self.staged, copy=True)
        self.staged_before = state["staging_before"].to(self.staged, copy=True)

    def keep_faults(self) -> None:
        """Write down what led to the present sicknesses, a file for each, where there is a folder for them."""
        if self.fault_folder is None:
            return
        causes = self.causes.cpu()
        for part, local, _ in self.split(causes.nonzero().squeeze(1)):
            for env, row in zip(local, self.rows[part].start + local, strict=True):
                cause = CAUSES[causes[row] - 1]
                self.batches[part].fault(env, cause, self._recorder.last(row)).save(self.fault_folder)

    def _latest(self) -> Tensor:
        """What MuJoCo wrote last, where the learner is."""
        rows = self._recorder.tensor
        return rows if self._on_cpu else rows.to(self.device, non_blocking=True)

    def _array(self, x: Tensor) -> NDArray[Any]:
        """A tensor, wherever it is, as an array; of the same memory if it is the CPU's."""
        return (x if self._on_cpu else x.cpu()).numpy()

    def _blocks(self, native: Tensor, ids: Tensor | slice = slice(None)) -> list[Tensor]:
        """Staging rows of some environments, from what MuJoCo wrote of them, as blocks of columns."""
        return self._layout.blocks(native, self.damping[ids], self.conventions.robot[ids], self.conventions)

    def _read(self) -> None:
        """Take what MuJoCo wrote last for the latest."""
        for batch, rows in zip(self.batches, self.rows, strict=True):
            batch.read(self._recorder.latest[rows])


def _let_overflow() -> None:
    """Ignore that numbers of who is sick are beyond single precision."""
    np.seterr(over="ignore")


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
