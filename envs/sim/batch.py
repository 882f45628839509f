"""All environments of one robot, stepped by MuJoCo's native threads; no Python runs between physics steps."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray

from ..robots.spec import Array, RobotSpec
from .fault import Fault
from .health import CAUSES, FlightRecorder, diagnose

_VEL = mujoco.mjtStage.mjSTAGE_VEL.value
_ACC = mujoco.mjtStage.mjSTAGE_ACC.value

Ids = NDArray[np.int64]


class RobotBatch:
    """``num_envs`` simulations of one robot. Angles given and returned here are native; slots are the pool's concern.

    kd lives in ``dof_damping`` so that the integrator treats it implicitly; a force limit therefore clips kp * error.
    """

    def __init__(
        self, spec: RobotSpec, model: mujoco.MjModel, num_envs: int, decimation: int, num_threads: int
    ) -> None:
        """Create the simulations, all in the model's default keyframe.

        Args:
            spec: the robot.
            model: its compiled model, see ``envs.robots.model.build_model``.
            num_envs: number of simulations.
            decimation: physics steps per control step.
            num_threads: threads, 0 for one per core.
        """
        self.spec = spec
        self.model = model
        self.num_envs = num_envs
        self._decimation = decimation
        self._batch = Batch(model, num_envs, num_threads)
        self.qpos: Array = self._batch.bind("qpos")
        self.qvel: Array = self._batch.bind("qvel")
        self.ctrl: Array = self._batch.bind("ctrl")
        self._time: Array = self._batch.bind("time")
        self._warmstart: Array = self._batch.bind("qacc_warmstart")
        self._xfrc: Array = self._batch.bind("xfrc_applied")
        self._actuator_force: Array = self._batch.bind("actuator_force")
        self.sensordata: Array = self._batch.bind("sensordata")
        self._base = int(model.jnt_bodyid[0])
        self._kd: Array = np.broadcast_to(spec.damping, (num_envs, spec.num_joints))
        self._last_time: Array = np.zeros(num_envs)
        self._recorder = FlightRecorder(num_envs, self._batch.nstate)
        self.causes: NDArray[np.int64] = np.zeros(num_envs, dtype=np.int64)
        """What went wrong with each simulation in the last step, 0 for nothing, shape (n,); see ``CAUSES``."""
        self._batch.reset(keyframe=0)

    @property
    def joint_torque(self) -> Array:
        """Torque of the last physics step: clipped kp * error minus kd * velocity [N m], shape (n, joints)."""
        return self._actuator_force - self._kd * self.qvel[:, 6:]

    def step(self, targets: Array) -> None:
        """Advance every simulation by one control step towards PD targets [rad], shape (n, joints).

        A simulation with a target that is not finite keeps the targets it had, and is reported in ``causes``.
        """
        wild = ~np.isfinite(targets.sum(axis=1))
        np.copyto(self.ctrl, targets, where=~wild[:, None])
        warned = self.advance()
        self._recorder.add(self._batch.state)
        self.causes = diagnose(self.qpos, self.qvel, self._time > self._last_time, warned, wild)
        self._last_time[:] = self._time

    def advance(self) -> NDArray[np.bool_]:
        """Nothing but physics; returns the simulations that MuJoCo warned about or refused to step, shape (n,)."""
        refused = np.zeros(self.num_envs, dtype=np.bool_)
        try:
            self._batch.step(nstep=self._decimation, stage=_VEL)
        except SimulationError as error:
            refused[error.ids] = True
        return refused | self._batch.warning[:, :, 1].any(axis=1)

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
        self._last_time[ids] = 0.0
        self._recorder.forget(ids)
        self._batch.warning[ids] = 0
        self.refresh(ids)

    def apply_base_wrench(self, wrench: Array) -> None:
        """Hold a world-frame force [N] and torque [N m] on every base until the next call, shape (n, 6)."""
        self._xfrc[:, self._base] = wrench

    def set_base_damping(self, damping: Array) -> None:
        """Set the damping of every base's rotation [N m s/rad], shape (n,)."""
        self._batch.expand("dof_damping")[:, 3:6] = damping[:, None]

    def push(self, ids: Ids, lin_vel_w: Array, ang_vel_b: Array) -> None:
        """Add velocity to some bases [m/s, rad/s], shape (m, 3) each."""
        self.qvel[ids, 0:3] += lin_vel_w
        self.qvel[ids, 3:6] += ang_vel_b

    def set_friction(self, ids: Ids, friction: Array) -> None:
        """Set the friction coefficient of the ground under some simulations, shape (m,).

        The ground has priority over the robot's geoms, so this alone is the effective coefficient.
        """
        floor = self.model.geom("floor").id
        self._batch.expand("geom_friction")[ids, floor, 0] = friction

    def set_gains(self, ids: Ids, stiffness: Array, damping: Array) -> None:
        """Set kp [N m/rad] and kd [N m s/rad] of some simulations, shape (m, joints)."""
        self._batch.expand("actuator_gainprm")[ids, :, 0] = stiffness
        self._batch.expand("actuator_biasprm")[ids, :, 1] = -stiffness
        self._batch.expand("dof_damping")[ids, 6:] = damping
        self._kd = self._batch.expand("dof_damping")[:, 6:]

    def change_bodies(self, length_scale: Array, mass_scale: Array, added_mass: Array, com_offset: Array) -> None:
        """Change every simulation's bodies once, then recompute the constants MuJoCo derives from them.

        Args:
            length_scale: factor on all lengths of the robot, shape (n,); inertia grows with its square.
            mass_scale: factor on mass and inertia of each body, shape (n, nbody).
            added_mass: mass added at the centre of mass [kg], shape (n, nbody).
            com_offset: shift of the centre of mass in the body frame [m], shape (n, nbody, 3).
        """
        length = length_scale[:, None, None]
        self._batch.expand("body_mass")[:] = self.model.body_mass * mass_scale + added_mass
        self._batch.expand("body_inertia")[:] = self.model.body_inertia * mass_scale[..., None] * length**2
        self._batch.expand("body_ipos")[:] = self.model.body_ipos * length + com_offset
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
            self._batch.expand(name)[:, bodies > 0] = np.multiply.outer(scale, nominal)

    def fault(self, env: int) -> Fault:
        """The last states of a simulation that ``causes`` names."""
        states = self._recorder.last(env)
        return Fault(
            robot=self.spec.name,
            robot_file=str(self.spec.yaml_path),
            cause=CAUSES[self.causes[env] - 1],
            env=env,
            time=states[:, 0],
            qpos=states[:, self._state_columns(mujoco.mjtState.mjSTATE_QPOS)],
            qvel=states[:, self._state_columns(mujoco.mjtState.mjSTATE_QVEL)],
            ctrl=states[:, self._state_columns(mujoco.mjtState.mjSTATE_CTRL)],
        )

    def _state_columns(self, component: mujoco.mjtState) -> slice:
        """Where a component lies in an integration state, whose components are in the order of their bits."""
        before = mujoco.mjtState.mjSTATE_INTEGRATION.value & (component.value - 1)
        start = mujoco.mj_stateSize(self.model, before)
        return slice(start, start + mujoco.mj_stateSize(self.model, component.value))

    def state(self) -> Array:
        """A copy of every simulation's integration state, shape (n, nstate)."""
        return self._batch.state.copy()

    def overwrite(self, state: Array) -> None:
        """Restore what :meth:`state` returned; derived quantities are old ones until the next step."""
        self._batch.state[:] = state

    def set_state(self, state: Array) -> None:
        """Restore what :meth:`state` returned and recompute the derived quantities."""
        self.overwrite(state)
        self._last_time[:] = self._time
        self._recorder.forget(slice(None))
        self.refresh(np.arange(self.num_envs))

    def snapshot(self, env: int) -> mujoco.MjData:
        """An MjData of one simulation, for rendering."""
        return self._batch.get_data(env)
