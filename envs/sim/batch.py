"""Simulations of one robot that a thread steps as one; no Python runs between physics steps."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray

from ..robots.spec import Array, RobotSpec
from .columns import consecutive
from .fault import Fault

_VEL = mujoco.mjtStage.mjSTAGE_VEL.value
_ACC = mujoco.mjtStage.mjSTAGE_ACC.value

Ids = NDArray[np.int64]


class RobotBatch:
    """``num_envs`` simulations of one robot. Angles given and returned here are native; slots are the pool's concern.

    kd lives in ``dof_damping`` so that the integrator treats it implicitly; a force limit therefore clips kp * error.
    """

    def __init__(
        self, spec: RobotSpec, model: mujoco.MjModel, num_envs: int, decimation: int, first_env: int = 0
    ) -> None:
        """Create the simulations, all in the model's default keyframe.

        Args:
            spec: the robot.
            model: its compiled model, see ``envs.robots.model.build_model``.
            num_envs: number of simulations.
            decimation: physics steps per control step.
            first_env: number of the first simulation among the robot's environments.
        """
        self.spec = spec
        self.model = model
        self.num_envs = num_envs
        self.first_env = first_env
        self._decimation = decimation
        self._batch = Batch(model, num_envs, nthread=1)
        self.qpos: Array = self._batch.bind("qpos")
        self.qvel: Array = self._batch.bind("qvel")
        self.ctrl: Array = self._batch.bind("ctrl")
        self._time: Array = self._batch.bind("time")
        self._warmstart: Array = self._batch.bind("qacc_warmstart")
        self._xfrc: Array = self._batch.bind("xfrc_applied")
        self._base_wrench = self._xfrc[:, int(model.jnt_bodyid[0])]
        self.actuator_force: Array = self._batch.bind("actuator_force")
        self.sensordata: Array = self._batch.bind("sensordata")
        sizes = {"status": 1, "warning": self._batch.warning.shape[1], "sensordata": model.nsensordata, "time": 1}
        sizes |= {"qpos": model.nq, "qvel": model.nv, "actuator_force": model.nu, "ctrl": model.nu}
        self.columns = consecutive(sizes)
        """Where everything lies in a row of :meth:`read`; up to ``qpos`` it is the same for every robot."""
        self.width = sum(sizes.values())
        """Of such a row."""
        motion = slice(self.columns["time"].start, self.columns["qvel"].stop)
        self._written = (
            (self.columns["status"], self._batch.status[:, None]),
            (self.columns["warning"], self._batch.warning[:, :, 1]),
            (self.columns["sensordata"], self.sensordata),
            (motion, self._batch.state[:, : 1 + model.nq + model.nv]),  # a state begins with time, qpos and qvel
            (self.columns["ctrl"], self.ctrl),
            (self.columns["actuator_force"], self.actuator_force),
        )
        self._own_fields: dict[str, Array] = {}
        self._batch.reset(keyframe=0)

    def step(self, targets: Array, aimed: NDArray[np.bool_] | bool = True) -> None:
        """Advance every simulation by one control step.

        Args:
            targets: PD targets [rad], shape (n, joints).
            aimed: whether a simulation takes them or keeps those it has, bool, shape (n, 1), or True for all.
        """
        if aimed is True:
            self.ctrl[:] = targets
        else:
            np.copyto(self.ctrl, targets, where=aimed)
        self.advance()

    def advance(self) -> None:
        """Nothing but physics. A simulation that MuJoCo refuses to step has a status of its own."""
        try:  # noqa: SIM105, which would be two more calls at each step
            self._batch.step(nstep=self._decimation, stage=_VEL)
        except SimulationError:
            pass

    def read(self, out: Array, ids: Ids | slice = slice(None)) -> None:
        """Copy what MuJoCo wrote of some simulations into their rows of ``out``, shape (n, ``width`` or more)."""
        for columns, values in self._written:
            out[ids, columns] = values[ids]

    def readings(self, out: Array) -> list[tuple[Array, Array]]:
        """Where :meth:`read` would write, and what it would, for who does so again and again."""
        return [(out[:, columns], values) for columns, values in self._written]

    def refresh(self, ids: Ids) -> None:
        """Recompute every derived quantity of some simulations from their state, after it was written."""
        self._batch.forward(ids, stage=_ACC)

    def reset(self, ids: Ids, qpos: Array, qvel: Array) -> None:
        """Put some simulations into given states with cleared forces, warm start, clock and warnings."""
        self.qpos[ids] = qpos
        self.qvel[ids] = qvel
        self.ctrl[ids] = qpos[:, 7:]
        self._time[ids] = 0.0
        self._warmstart[ids] = 0.0
        self._xfrc[ids] = 0.0
        self._batch.warning[ids] = 0
        self.refresh(ids)

    def _own(self, name: str) -> Array:
        """A field of the model of which every simulation has its own, shape (n, ...)."""
        if name not in self._own_fields:
            self._own_fields[name] = self._batch.expand(name)
        return self._own_fields[name]

    def apply_base_wrench(self, wrench: Array) -> None:
        """Hold a world-frame force [N] and torque [N m] on every base until the next call, shape (n, 6) or (6,)."""
        self._base_wrench[:] = wrench

    def set_base_damping(self, damping: Array) -> None:
        """Set the damping of every base's rotation [N m s/rad], shape (n,)."""
        self._own("dof_damping")[:, 3:6] = damping[:, None]

    def push(self, ids: Ids, lin_vel_w: Array, ang_vel_b: Array) -> None:
        """Add velocity to some bases [m/s, rad/s], shape (m, 3) each."""
        self.qvel[ids, 0:3] += lin_vel_w
        self.qvel[ids, 3:6] += ang_vel_b

    def set_friction(self, ids: Ids, friction: Array) -> None:
        """Set the friction coefficient of the ground under some simulations, shape (m,).

        The ground has priority over the robot's geoms, so this alone is the effective coefficient.
        """
        floor = self.model.geom("floor").id
        self._own("geom_friction")[ids, floor, 0] = friction

    def set_gains(self, ids: Ids, stiffness: Array, damping: Array) -> None:
        """Set kp [N m/rad] and kd [N m s/rad] of some simulations, shape (m, joints)."""
        self._own("actuator_gainprm")[ids, :, 0] = stiffness
        self._own("actuator_biasprm")[ids, :, 1] = -stiffness
        self._own("dof_damping")[ids, 6:] = damping

    def change_bodies(self, length_scale: Array, mass_scale: Array, added_mass: Array, com_offset: Array) -> None:
        """Change every simulation's bodies once, then recompute the constants MuJoCo derives from them.

        Args:
            length_scale: factor on all lengths of the robot, shape (n,); inertia grows with its square.
            mass_scale: factor on mass and inertia of each body, shape (n, nbody).
            added_mass: mass added at the centre of mass [kg], shape (n, nbody).
            com_offset: shift of the centre of mass in the body frame [m], shape (n, nbody, 3).
        """
        length = length_scale[:, None, None]
        self._own("body_mass")[:] = self.model.body_mass * mass_scale + added_mass
        self._own("body_inertia")[:] = self.model.body_inertia * mass_scale[..., None] * length**2
        self._own("body_ipos")[:] = self.model.body_ipos * length + com_offset
        if (length_scale != 1.0).any():
            self._scale_geometry(length_scale)
        self._batch.set_const()

    def _scale_geometry(self, scale: Array) -> None:
        """Multiply every length of the robot, but not of the ground, by a factor, shape (n,)."""
        model = self.model
        owners = {"body_pos": np.arange(model.nbody), "jnt_pos": model.jnt_bodyid, "site_pos": model.site_bodyid}
        owners |= dict.fromkeys(("geom_pos", "geom_size", "geom_rbound"), model.geom_bodyid)
        for name, bodies in owners.items():
            nominal = getattr(model, name)[bodies > 0]
            self._own(name)[:, bodies > 0] = np.multiply.outer(scale, nominal)

    def fault(self, env: int, cause: str, rows: Array) -> Fault:
        """What a simulation did before it fell ill, from rows of its last steps, see ``columns``, shape (k, width)."""
        return Fault(
            robot=self.spec.name,
            robot_file=str(self.spec.yaml_path),
            cause=cause,
            env=self.first_env + env,
            time=rows[:, self.columns["time"].start],
            qpos=rows[:, self.columns["qpos"]],
            qvel=rows[:, self.columns["qvel"]],
            ctrl=rows[:, self.columns["ctrl"]],
        )

    def state(self) -> Array:
        """A copy of every simulation's integration state, shape (n, nstate)."""
        return self._batch.state.copy()

    def overwrite(self, state: Array) -> None:
        """Restore what :meth:`state` returned; derived quantities are old ones until the next step."""
        self._batch.state[:] = state

    def set_state(self, state: Array) -> None:
        """Restore what :meth:`state` returned and recompute the derived quantities."""
        self.overwrite(state)
        self.refresh(np.arange(self.num_envs))
