"""The arithmetic of a control step: what its parts return, and what they read and write when they are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from eagle_rl.config.schema import TaskCfg

from .ground import Plane
from .mdp.active_commands import ActiveCommands
from .mdp.aids import harness_wrench
from .mdp.commands import DrawnCommands, is_standing
from .mdp.gait import advance_phase, foot_phases
from .mdp.layout import SENSED_SIZE
from .mdp.metrics import contact_match, measured_commands, tracking_errors
from .mdp.observations import (
    History,
    clock_observation,
    command_observation,
    critic_observation,
    delay,
    estimation_target,
    proprioception,
)
from .mdp.posture import RestingPose
from .mdp.randomization import Draws, Randomizer
from .mdp.rewards import RewardContext, compute_rewards, success_scores
from .mdp.terminations import REASONS, terminations
from .measure import measured
from .recording import InBlocks, Recording
from .rng import CounterRng
from .sim.health import MAX_ACTION
from .sim.pool import PhysicsPool
from .state import PooledRobots, PooledState, carries
from .step_log import StepLog

BLOCK = 8
"""Environments that a kernel resets at a time."""


class Judgement(NamedTuple):
    """What came of a control step."""

    rewards: Tensor
    """Float32, shape (N,)."""
    dones: Tensor
    """Whether the episode ended, bool, shape (N,)."""
    time_outs: Tensor
    """Whether it ended by its time limit alone, bool, shape (N,)."""
    fallen: Tensor
    """Whether it ended by a fall, bool, shape (N,)."""
    cut: Tensor
    """Whether it is cut by other than failure: by its time limit, or by a new command or a push before the next step,
    which are noise to who learns (docs/experiments.md, 14); bool, shape (N,)."""
    flags: Tensor
    """Whether any of ``dones``, of ``cut``, of the commands whose time is up, of the sick, bool, shape (4,)."""
    command: Tensor
    """What follows are the fields of ``DerivedGroups``."""
    clock: Tensor
    critic: Tensor
    estimate: Tensor


class Sight(NamedTuple):
    """What a reset or a new command changes in what is observed, a row for each of some environments."""

    staged: Tensor
    """Staging rows."""
    frame: Tensor
    """Clean, see ``proprioception``."""
    command: Tensor
    """What follows are the fields of ``DerivedGroups``."""
    clock: Tensor
    critic: Tensor
    estimate: Tensor


class DerivedGroups(NamedTuple):
    """Observation groups that are worked out from the state, float32, see ``ObservationLayout``."""

    command: Tensor
    clock: Tensor
    critic: Tensor
    estimate: Tensor

    @classmethod
    def of(cls, seen: Judgement | Sight) -> DerivedGroups:
        """Those that were worked out with other things."""
        return cls(seen.command, seen.clock, seen.critic, seen.estimate)


class Episode(NamedTuple):
    """What is drawn for the beginning of an episode, a row for each of some environments."""

    root: Tensor
    """See ``Randomizer.initial_state``, shape (n, 13)."""
    joint_pos: Tensor
    joint_vel: Tensor
    command: Tensor
    """What follows are the fields of ``DrawnCommands``."""
    bins: Tensor
    creditable: Tensor
    friction: Tensor | None = None
    """What follows are the fields of ``Draws``, if anything is randomized."""
    motor_offset: Tensor | None = None
    latency: Tensor | None = None
    stiffness_scale: Tensor | None = None
    damping_scale: Tensor | None = None

    @property
    def commands(self) -> DrawnCommands:
        """The commands."""
        return DrawnCommands(self.command, self.bins, self.creditable)

    @property
    def draws(self) -> Draws | None:
        """What is randomized."""
        draws = (self.friction, self.motor_offset, self.latency, self.stiffness_scale, self.damping_scale)
        return None if self.friction is None else Draws(*draws)  # type: ignore[arg-type]


class ControlStep:
    """What a control step does besides physics, all of it arithmetic on tensors of the pool.

    Its parts neither branch on values nor count, so that they can be compiled; a part reads and writes what
    ``_PARTS`` says.
    """

    task: TaskCfg
    step_dt: float
    max_episode_length: int
    device: torch.device
    pool: PhysicsPool
    rng: CounterRng
    randomizer: Randomizer
    robots: PooledRobots
    commands: ActiveCommands
    posture: RestingPose
    ground: Plane
    step_log: StepLog
    embodiment: Tensor | None
    history: History
    episode_count: Tensor
    episode_length_buf: Tensor
    phase: Tensor
    _live: Tensor
    _step_count: Tensor
    _harness: Tensor | None
    _gait_shaping: Tensor
    _reward_factors: Tensor
    _noise: Tensor
    """Of each robot, shape (R, F), see ``noise_scale``."""
    _noise_keys: Tensor
    _last_frame: Tensor
    _actions: Tensor
    _last_actions: Tensor
    _last_last_actions: Tensor
    _state: PooledState | None
    _groups: DerivedGroups | None

    @property
    def state(self) -> PooledState:
        """What every robot did in the last step, under the command now in force; worked out when it is asked for."""
        if self._state is None:
            self._state = self._derive(self.pool.staged, self.pool.staged_before)
        return self._state

    @property
    def command(self) -> Tensor:
        """Commands in force (v_x, v_y, omega, h, p), shape (N, 5)."""
        return self.commands.command

    def tracking_errors(self) -> Tensor:
        """Absolute error of each command at the last step [m/s, m/s, rad/s, m, rad], shape (N, 5)."""
        return tracking_errors(self.state, self.robots)

    def measured_commands(self) -> Tensor:
        """What each command asks for, as it is now [m/s, m/s, rad/s, m, rad], shape (N, 5)."""
        return measured_commands(self.state, self.robots)

    def balance(self) -> tuple[Tensor, Tensor]:
        """Gravity in the base frame, (N, 3), and which joints are at a soft limit or beyond, bool, (N, 32)."""
        state, robots = self.state, self.robots
        ended = (state.joint_pos <= robots.joint_soft_lower) | (state.joint_pos >= robots.joint_soft_upper)
        return state.projected_gravity_b, ended & self._live

    # --- parts of a step ----------------------------------------------------------------------------------------------

    def _aim(self, actions: Tensor) -> tuple[Tensor, Tensor | None]:
        """Native PD targets, (N, most joints), and the harness' wrench on the bases, (N, 6), or None without one."""
        targets = self.pool.aim(self._act(actions))
        harness = self._harness
        return targets, None if harness is None else harness_wrench(self.state, self.robots, harness).double()

    def _act(self, actions: Tensor) -> Tensor:
        """Remember the actions and turn them into canonical PD targets [rad], (N, 32); NaN where one is absurd."""
        clip, live = self.task.control.action_clip, self._live
        sound = actions.abs() <= MAX_ACTION
        self._last_last_actions, self._last_actions = self._last_actions, self._actions
        self._actions = torch.where(live & sound, actions.to(self._actions.dtype).clamp(-clip, clip), 0.0)
        targets = self.posture.advance(self.command) + self.robots.action_scale * self._actions
        absurd = ~(torch.where(live, actions, 0.0).abs().amax(dim=1, keepdim=True) <= MAX_ACTION)
        return (targets + self.randomizer.motor_offset).masked_fill(absurd, torch.nan)

    def _judge(self) -> Judgement:
        """Stage what physics wrote, derive the new state, see what came of the step and what is sensed of it."""
        self.pool.stage()
        self.episode_length_buf, self._step_count = self.episode_length_buf + 1, self._step_count + 1
        self.phase = advance_phase(self.phase, self.step_dt, self.robots.gait_frequency)
        state, task, robots, causes = self.state, self.task, self.robots, self.pool.causes
        sick = causes > 0
        reasons = terminations(state, task.terminations)
        fallen = torch.stack(list(reasons.values())).any(dim=0) & ~sick
        over = (self.episode_length_buf >= self.max_episode_length) | self.ground.left(state.root_pos_w)
        time_outs = over & ~(fallen | sick)
        dones = fallen | sick | time_outs
        context = RewardContext(cfg=task.rewards, gait=task.gait, gait_shaping=self._gait_shaping, terminated=fallen)
        rewards, terms = compute_rewards(state, robots, context, self._reward_factors)
        scores = torch.stack(success_scores(state, robots, context), dim=1)
        self.ground.judge(scores[:, 0], state)
        errors, match = self.tracking_errors(), contact_match(state, task.gait)
        falls, why = dones & ~time_outs, [reasons[name] for name in REASONS]
        self.step_log.add([*terms.values()], why, causes, errors, match, falls, dones, state.standing)
        self.commands.judge(scores)
        due = self.commands.due()
        surprised = due | self.randomizer.pushes_at(self._step_count, self.step_dt)
        cut = time_outs | (surprised & ~dones)
        flags = torch.stack([where.any() for where in (dones, cut, due, sick)])
        self._observe()
        rewards = rewards.masked_fill(sick, 0.0).float()
        return Judgement(rewards, dones, time_outs, fallen, cut, flags, *self._derive_groups())

    def _derive_groups(self) -> DerivedGroups:
        """The observation groups that are worked out from the present state."""
        return self._groups_of(self.state, self.robots, self.embodiment, self._last_frame)

    def _groups_of(
        self, state: PooledState, robots: PooledRobots, embodiment: Tensor | None, frame: Tensor
    ) -> DerivedGroups:
        """The observation groups of robots in these states whose clean frames are these."""
        cfg, friction = self.task.observations, self.task.randomization.friction
        return DerivedGroups(
            command_observation(state, cfg).float(),
            clock_observation(state, cfg).float(),
            critic_observation(frame, state, robots, embodiment, cfg, friction).float(),
            estimation_target(state, embodiment, cfg).float(),
        )

    def _look(self, ids: Tensor) -> Sight:
        """See anew some environments, shape (n,), whose robots or commands have changed; nothing is written."""
        staged, robots = self.pool.staging_rows(ids), self.robots.rows(ids)
        state = self._derive(staged, staged, ids)
        frame = proprioception(state, robots, self.task.observations)
        embodiment = None if self.embodiment is None else self.embodiment[ids]
        return Sight(staged, frame, *self._groups_of(state, robots, embodiment, frame))

    def _begin(self, ids: Tensor) -> Episode:
        """Draw how new episodes of some environments, shape (n,), begin; nothing changes."""
        count = self.episode_count[ids]
        drawn = self.commands.sampler.draw(ids, self.commands.count[ids])
        draws = self.randomizer.draw(ids, count, self.step_dt)
        return Episode(*self.randomizer.initial_state(ids, count), *drawn, *(draws or ()))

    def _sense(self) -> tuple[Tensor]:
        """The clean frame of the present state, (N, F)."""
        return (proprioception(self.state, self.robots, self.task.observations),)

    def _observe(self) -> None:
        """Push the frame of the present state, delayed and corrupted, into the history."""
        (frame,) = self._sense()
        sensed = delay(frame, self._last_frame, self.randomizer.latency)
        if self.task.observations.enable_corruption:
            u = self.rng.uniform_in(-1.0, 1.0, self._noise_keys, self._step_count, SENSED_SIZE)
            sensed = sensed.addcmul(u.to(frame.dtype), self._noise[self.robots.robot_id, :SENSED_SIZE])
        self._last_frame = frame
        self.history.push(sensed, frame[:, SENSED_SIZE:])

    def _derive(self, staged: Tensor, before: Tensor, ids: Tensor | slice = slice(None)) -> PooledState:
        """The state of some environments, with the command, phase and actions now in force.

        Args:
            staged: their staging rows, shape (n, columns).
            before: the same one step earlier.
            ids: the environments, shape (n,).
        """
        physical, earlier = (measured(rows, self.pool.columns) for rows in (staged, before))
        command = self.command[ids]
        standing = is_standing(command)
        return PooledState(
            **physical,
            **self.ground.measure(physical["root_pos_w"], physical["root_quat_w"], physical["foot_pos_w"]),
            joint_acc=(physical["joint_vel"] - earlier["joint_vel"]) / self.step_dt,
            last_foot_contact=carries(earlier["foot_force_w"]),
            friction=self.randomizer.friction[ids],
            command=command,
            standing=standing,
            foot_phase=foot_phases(self.phase[ids], standing, self.task.gait),
            actions=self._actions[ids],
            last_actions=self._last_actions[ids],
            last_last_actions=self._last_last_actions[ids],
        )

    def _forget(self) -> None:
        """What was worked out of the state no longer holds."""
        self._state, self._groups = None, None


_STATE = (
    *("pool.staged", "pool.staged_before", "_actions", "_last_actions", "_last_last_actions", "phase"),
    *("commands.command", "randomizer.friction", "robots"),
)
"""What ``HumanoidEnv.state`` is made of."""
_ACTIONS = ("_actions", "_last_actions", "_last_last_actions")
_FOLLOWED = ("commands.age", "commands.sampler.sums", "step_log.sums")
_PARTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "_aim": (
        (*_STATE, "randomizer.motor_offset", "_live", "_harness", "pool.conventions"),
        (*_ACTIONS, "pool.wild", "pool.any_wild"),
    ),
    "_judge": (
        (
            *_STATE,
            *("pool.native", "pool.conventions", "pool.damping", "pool.clock", "pool.wild"),
            *("episode_length_buf", "_last_frame", "history.flat", "randomizer.latency", "embodiment"),
            *("_step_count", "_noise", "_noise_keys", "_gait_shaping", "_reward_factors", *_FOLLOWED),
        ),
        (
            *("pool.staged", "pool.staged_before", "pool.causes", "pool.clock", "episode_length_buf", "phase"),
            *("_last_frame", "_step_count", "history.flat", *_FOLLOWED),
        ),
    ),
    "_derive_groups": ((*_STATE, "_last_frame", "embodiment"), ()),
    "_look": ((*_STATE, "pool.native", "pool.damping", "pool.conventions", "embodiment"), ()),
    "_begin": (
        (
            *("randomizer.robots", "episode_count", "randomizer.reset_keys", "randomizer.start_keys"),
            *("commands.count", "commands.sampler.keys", "commands.sampler.weights", "commands.sampler.robot_id"),
        ),
        (),
    ),
}
"""Parts of ``HumanoidEnv.step``: attributes that each reads and writes."""


def compile_step(env: ControlStep) -> None:
    """Let an environment take its steps by compiled kernels.

    It takes half a minute, or a few seconds where TorchInductor has compiled the same for as many environments before.

    Raises:
        CompileError: there is no C++ compiler, or it failed; the environment is as it was.
    """
    more = {"_aim": env.posture.ATTRIBUTES, "_judge": env.ground.ATTRIBUTES}
    recordings: dict[str, Recording] = {}
    for name, (reads, writes) in _PARTS.items():
        read, written = more.get(name, ((), ()))
        recording = Recording(env, getattr(env, name), (*reads, *read), (*writes, *written), ("_state",))
        recording.make(*_EXAMPLES.get(name, lambda _: ())(env))
        recordings[name] = recording
    some = {name: InBlocks(recordings[name], getattr(env, name), BLOCK) for name in ("_begin", "_look")}
    vars(env).update(recordings | some)


_EXAMPLES: dict[str, Callable[[ControlStep], tuple[Tensor, ...]]] = {
    "_aim": lambda env: (torch.zeros_like(env._actions, dtype=torch.float32),),
    "_begin": lambda env: (torch.zeros(BLOCK, dtype=torch.long, device=env.device),),
    "_look": lambda env: (torch.zeros(BLOCK, dtype=torch.long, device=env.device),),
}
"""Arguments of those parts that have some."""
