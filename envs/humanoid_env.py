"""The task: several robots, one pool, one rsl_rl ``VecEnv``. The order of a step is written here and nowhere else."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.config.schema import TaskCfg
from eagle_rl.errors import CompileError, EagleWarning

from .control_step import ControlStep, DerivedGroups, Sight, compile_step
from .ground import make_ground
from .mdp.active_commands import ActiveCommands
from .mdp.aids import LearningAids, harness_damping
from .mdp.commands import CommandSampler
from .mdp.curriculum import penalty_scale
from .mdp.observations import (
    History,
    ObservationLayout,
    noise_scale,
    scan_points,
)
from .mdp.posture import make_posture
from .mdp.randomization import Randomizer
from .mdp.rewards import reward_factors, terms_in_use
from .mdp.terminations import REASONS
from .pooling import pool_robots, share
from .rng import CounterRng
from .robots.embodiment import pooled_embodiment
from .robots.model import build_model
from .robots.slots import NUM_SLOTS, SLOT_NAMES
from .robots.spec import RobotSpec
from .sim.pool import PhysicsPool
from .sim.terrain import Terrain, build_terrain
from .step_log import StepLog, episode_ratio

Pooling = Literal["mean", "max"]

STAGGER = 20
"""Control steps between those at which the time limits of staggered episodes are met."""


class HumanoidEnv(ControlStep, VecEnv):
    """Whole-body command tracking by a mixed fleet of humanoids.

    Actions, observations, rewards and terminations are computed once over the pool, in slot space.
    """

    num_actions = NUM_SLOTS
    slot_names = SLOT_NAMES
    final_of_episodes = False
    """Whether ``final_ids`` lists every environment whose episode ended, as Gymnasium wants it, and no other."""
    over_processes: Callable[[Tensor, Pooling], Tensor] = staticmethod(lambda x, how: x)
    """Pools what the curriculum goes by with other processes that train the same policy, once an interval."""

    def __init__(
        self,
        task: TaskCfg,
        robots: Sequence[RobotSpec],
        num_envs: int,
        seed: int,
        device: str = "cpu",
        num_threads: int = 0,
        dtype: torch.dtype = torch.float32,
        first_env: int = 0,
    ) -> None:
        """Build the pool and reset every environment.

        Args:
            task: the Markov decision process.
            robots: the fleet; environments are shared equally, a remainder goes to the first robots.
            num_envs: environments over all robots, N.
            seed: root of every random stream.
            device: where everything but the physics lives.
            num_threads: physics threads, 0 for one per core.
            dtype: precision of the pooled state; observations are always float32.
            first_env: number each robot's first environment goes by in the random streams, so that a large pool can be
                simulated in parts that draw what the whole would.
        """
        self.task, self.cfg = task, asdict(task)
        self.num_envs = num_envs
        self.device = torch.device(device)
        self.step_dt = task.sim.physics_dt * task.sim.decimation
        self.max_episode_length = round(task.terminations.episode_length_s / self.step_dt)
        self.robot_names = [spec.name for spec in robots]
        counts, terrain = share(num_envs, len(robots)), build_terrain(task.terrain, seed)
        field = terrain.field if terrain is not None else None
        simulated = [
            (spec, build_model(spec, task.sim, field), count) for spec, count in zip(robots, counts, strict=True)
        ]
        self.pool = PhysicsPool(simulated, task.sim.decimation, self.device, dtype, num_threads)
        self.rng = CounterRng(
            seed,
            [name for name, count in zip(self.robot_names, counts, strict=True) for _ in range(count)],
            torch.cat([first_env + torch.arange(count) for count in counts]).to(self.device),
        )
        nominal = pool_robots(robots, counts, task, self.device, dtype)
        self.randomizer = Randomizer(task.randomization, self.pool, nominal, self.rng)
        self.robots = self.randomizer.robots
        self._make_task(robots, terrain, dtype)
        self._allocate(dtype)
        self._apply_aids()
        self.reset()
        self._no_observations = self.get_observations()[:0].clone()

    def _make_task(self, robots: Sequence[RobotSpec], terrain: Terrain | None, dtype: torch.dtype) -> None:
        """What the robots are asked for, stand on and are told, and how it looks in a mirror."""
        task, dt, observations, device = self.task, self.step_dt, self.task.observations, self.device
        sampler = CommandSampler(task.commands, self.robots, len(robots), self.rng, dt)
        self.commands = ActiveCommands(sampler, round(task.commands.resampling_time_s / dt), dtype)
        self.aids = LearningAids(task.aids, len(robots), device)
        self.posture = make_posture(task.control, robots, self.robots, dt)
        points = scan_points(observations).to(device, dtype)
        self.ground = make_ground(terrain, points, self.robots.robot_id, self.rng, dt, self.max_episode_length)
        self.step_log = StepLog(self.robot_names, self.robots.robot_id, terms_in_use(task.rewards.weights), REASONS)
        self.embodiment = (
            pooled_embodiment(robots, self.robots.robot_id, self.randomizer.bodies, observations.descriptor)
            if observations.embodiment_observation
            else None
        )
        self.layout = ObservationLayout(observations)
        self.mirror = self.layout.mirror(device)
        first_of_each = self.robots.rows(torch.searchsorted(self.robots.robot_id, torch.arange(len(robots)).to(device)))
        self._noise, self._noise_keys = noise_scale(observations, first_of_each), self.rng.keys("observation_noise")

    def _allocate(self, dtype: torch.dtype) -> None:
        """Buffers that outlive a step."""
        n, device = self.num_envs, self.device
        self._live = self.robots.slot_mask > 0
        self._single = dtype is torch.float32
        self._all = torch.arange(n, device=device)
        self._nobody = self._all[:0]
        self.common_step_counter, self._stagger = 0, 1
        self._step_count = torch.zeros((), dtype=torch.long, device=device)
        self.episode_length_buf = torch.zeros(n, dtype=torch.long, device=device)
        self.episode_count = torch.zeros(n, dtype=torch.long, device=device)
        self.phase = torch.zeros(n, dtype=dtype, device=device)
        zeros = torch.zeros(n, NUM_SLOTS, dtype=dtype, device=device)
        self._actions = self._last_actions = self._last_last_actions = zeros
        self._harness: Tensor | None = None
        self._weigh()
        self._compile_at: int | None = None
        self._forget()
        (self._last_frame,) = self._sense()
        self.history = History(n, self.task.observations.history_length, self._last_frame)

    # --- the step -----------------------------------------------------------------------------------------------------

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Advance one control step.

        Args:
            actions: policy output in slots, shape (N, 32); absent slots are ignored. Where an action is not finite or
                absurd, the environment counts as sick.

        Returns:
            Observations after resets, rewards (N,), dones (N,), and extras with ``time_outs``, ``log``, how long the
            physics took [s] (``physics_time``), and ``final_observations`` of the environments ``final_ids``, whose
            returns are to end there and be bootstrapped: they timed out, or get a new command or a push next. With
            ``final_of_episodes`` those whose episodes end, and ``final_poses``, the ``qpos`` of each.
        """
        if self._compile_at is not None and self.common_step_counter >= self._compile_at:
            self._compile_at = None
            try:
                compile_step(self)
            except CompileError as error:
                warnings.warn(f"{error} Training goes on without, a little slower.", EagleWarning, stacklevel=2)
        self._physics_step(*self._aim(actions))
        self.common_step_counter += 1
        if self.common_step_counter % self.task.rewards.penalty_interval_steps == 0:
            self._weigh()
        self._forget()
        judged = self._judge()
        dones, time_outs, self._groups = judged.dones, judged.time_outs, DerivedGroups.of(judged)
        any_done, any_cut, any_due, any_sick = judged.flags.tolist()
        if any_sick:
            self.pool.keep_faults()
        extras: dict[str, Any] = {"time_outs": time_outs, "physics_time": self._physics_time}
        extras |= self._final(dones, any_done) if self.final_of_episodes else self._final(judged.cut, any_cut)
        if self.final_of_episodes:
            extras["final_poses"] = self.pool.poses(extras["final_ids"])
        extras["log"] = self._account()
        if any_done:
            reset_ids = dones.nonzero().squeeze(1)
            self._reset(reset_ids, judged.fallen[reset_ids])
        if any_due:
            self._resample()
        return self.get_observations(), judged.rewards, dones, extras

    def compile(self, from_step: int | None = None) -> None:
        """Take steps by compiled kernels, equal up to rounding, see :func:`compile_step`.

        Args:
            from_step: control step since creation from which on to do so; they are compiled then, and if they cannot
                be, that is a warning. None compiles them now.

        Raises:
            CompileError: there is no C++ compiler, or it failed.
        """
        self._compile_at = from_step
        if from_step is None:
            compile_step(self)

    def stagger(self) -> None:
        """Give episodes ages drawn by torch's generator, so that not all end at once, but always several together.

        A reset takes as long for eight environments as for one. So time limits are met only at every
        ``STAGGER``-th control step, for which an episode that follows a fall is a little shorter.
        """
        self._stagger = max(1, min(STAGGER, self.max_episode_length // 50))
        groups = torch.randint_like(self.episode_length_buf, self.max_episode_length // self._stagger)
        self.episode_length_buf = self._age_at_start() + self._stagger * groups

    def reset(self) -> None:
        """Start new episodes everywhere; random streams go on."""
        self._forget()
        self.pool.staged = self.pool.staged.clone()  # what was handed out keeps its values
        self.history.flat = self.history.flat.clone()
        self._reset(self._all, torch.zeros_like(self._all, dtype=torch.bool))

    def get_observations(self) -> TensorDict:
        """Observation groups at the present state; they keep their values when the environment moves on."""
        if self._groups is None:
            self._groups = self._derive_groups()
        own = {"history": self.history.flat, "slot_mask": self.robots.slot_mask, "phase": self.phase}
        tensors = own if self._single else {name: value.float() for name, value in own.items()}
        tensors |= self._groups._asdict()
        return TensorDict(tensors | {"robot": self.robots.robot_id}, batch_size=[self.num_envs])

    def pin_commands(self, command: Tensor | None) -> None:
        """Hold these commands, shape (N, 5), instead of sampling; ``None`` returns to sampling at the next draw."""
        self.commands.pin(command)
        self._forget()

    @property
    def penalty_scale(self) -> float:
        """k, the factor on the penalties of the curriculum (HugWBC 4)."""
        return penalty_scale(self.task.rewards, self.common_step_counter)

    @property
    def fault_folder(self) -> Path | None:
        """Where the last states of sick environments are kept; None keeps none."""
        return self.pool.fault_folder

    @fault_folder.setter
    def fault_folder(self, folder: Path | None) -> None:
        self.pool.fault_folder = folder

    # --- parts of the step --------------------------------------------------------------------------------------------

    def _final(self, where: Tensor, anywhere: bool) -> dict[str, Any]:
        """The environments, bool (N,), whose returns end here, and what is observed there before anything is reset."""
        if not anywhere:
            return {"final_ids": self._nobody, "final_observations": self._no_observations}
        ids = where.nonzero().squeeze(1)
        return {"final_ids": ids, "final_observations": self.get_observations()[ids]}

    def _age_at_start(self) -> int:
        """Control steps that an episode which begins now is taken to have lasted, see :meth:`stagger`."""
        return self.common_step_counter % self._stagger

    def _weigh(self) -> None:
        """Weight the reward terms as the penalties' curriculum has it."""
        self._reward_factors = reward_factors(self.task.rewards.weights, self.penalty_scale, self.step_dt, self.phase)

    def _physics_step(self, targets: Tensor, wrench: Tensor | None) -> None:
        """Push, help and step every robot."""
        self.randomizer.push(self.common_step_counter, self.penalty_scale, self.step_dt)
        start = time.perf_counter()
        self.pool.advance(targets, wrench)
        self._physics_time = time.perf_counter() - start

    def _apply_aids(self) -> None:
        """Spread the aids' scales over the environments, and put the harness' share of the damping in force."""
        robot, dtype = self.robots.robot_id, self.command.dtype
        self._gait_shaping = self.aids.gait_shaping[robot].to(dtype)
        harness = self.aids.harness[robot].to(dtype)
        held, self._harness = self._harness is not None, harness if harness.any() else None
        if held and self._harness is None:
            self.pool.release()
        if self.task.aids.harness > 0:
            self.pool.set_base_damping(harness_damping(self.robots, harness))

    def _reset(self, ids: Tensor, fallen: Tensor) -> None:
        """Start new episodes, some of them, bool (n,), after a fall; other environments are untouched, bit for bit."""
        count = self.episode_count[ids]
        if self.ground.has_levels:
            self.ground.advance(ids, count, self.state, self.episode_length_buf)
        self.commands.close(ids, fallen)
        begun = self._begin(ids)
        if begun.draws is not None:
            self.randomizer.put(ids, begun.draws)
        self.pool.place(ids, self.ground.place(ids, count, begun.root), begun.joint_pos, begun.joint_vel)
        self.episode_count[ids] += 1
        self.episode_length_buf = self.episode_length_buf.index_fill(0, ids, self._age_at_start())
        self.phase = self.phase.index_fill(0, ids, 0.0)
        self.commands.renew(ids, fallen, begun.commands)
        self.posture.reset(ids)
        for name in ("_actions", "_last_actions", "_last_last_actions"):
            setattr(self, name, getattr(self, name).index_fill(0, ids, 0))
        seen = self._see(ids)
        self.pool.restage(ids, seen.staged)
        self._last_frame[ids] = seen.frame
        self.history.reset(ids, seen.frame)

    def _see(self, ids: Tensor) -> Sight:
        """Observe some environments anew, shape (n,); the others are observed as they were."""
        self._state = None
        seen = self._look(ids)
        for group, rows in zip(self._groups or (), DerivedGroups.of(seen), strict=False):
            group[ids] = rows
        return seen

    def _resample(self) -> None:
        """Draw new commands where their time is still up after resets."""
        ids = self.commands.due().nonzero().squeeze(1)
        if len(ids):
            self.commands.draw(ids)
            self._see(ids)

    def _account(self) -> dict[str, Tensor | float]:
        """Now and then, let the aids see how it went; returns tags and values then."""
        if self.common_step_counter % self.task.aids.interval_steps:
            return {}
        entry, falls_per_step, match_per_robot = self.step_log.flush(self.task.aids.interval_steps)
        falls, match_per_robot = self.over_processes(torch.stack((falls_per_step, match_per_robot)), "mean")
        self.aids.update(episode_ratio(falls, self.max_episode_length), match_per_robot)
        self._apply_aids()
        self.commands.sampler.weights = self.over_processes(self.commands.sampler.weights, "max")
        entry["Curriculum/penalty_scale"] = self.penalty_scale
        names = self.robot_names
        return entry | self.commands.log() | self.aids.log(names) | self.ground.log(names)

    # --- exact resume -------------------------------------------------------------------------------------------------

    _BUFFERS = "episode_length_buf episode_count phase _actions _last_actions _last_last_actions _last_frame".split()

    _PARTS = ("randomizer", "pool", "commands", "posture", "ground", "aids", "step_log")
    """What has a state of its own; randomization first, because the physics is recomputed under it."""

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs to go on bit for bit (tensors and numbers only)."""
        return {
            "common_step_counter": self.common_step_counter,
            "stagger": self._stagger,
            "buffers": {name: getattr(self, name).clone() for name in self._BUFFERS},
            "history": self.history.flat.clone(),
        } | {name: getattr(self, name).state_dict() for name in self._PARTS}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned, in an environment built from the same configuration and seed."""
        self.common_step_counter, self._stagger = state["common_step_counter"], state["stagger"]
        self._step_count = torch.full_like(self._step_count, self.common_step_counter)
        self._weigh()
        for name in self._BUFFERS:
            setattr(self, name, state["buffers"][name].to(self.device, copy=True))
        self.history.flat = state["history"].to(self.device, copy=True)
        for name in self._PARTS:
            getattr(self, name).load_state_dict(state[name])
        self._apply_aids()
        self._forget()
