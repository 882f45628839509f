"""The task for gymnasium: ``eagle/Humanoid-v0``, registered when this module is imported.

    import envs.gym
    vector = gymnasium.make_vec("eagle/Humanoid-v0", num_envs=64, vectorization_mode="vector_entry_point",
                                robots=["h1", "g1"])
    single = gymnasium.make("eagle/Humanoid-v0", robots=["g1"])

Without the import, ``gymnasium.make("envs.gym:eagle/Humanoid-v0", ...)`` does the same.

Observation, a dictionary of float32 arrays (columns, units and scales in ``envs.mdp.layout``):

    =========== ======= ==================================================================================
    history     K * 102 the last K frames of proprioception, newest first
    command     5       v_x, v_y [m/s], omega [rad/s], height offset [m], pitch [rad], scaled
    clock       2       sin(2 pi phase) of left and right foot (more with ``observations.clock_harmonics``)
    slot_mask   32      1 where the robot has a joint
    =========== ======= ==================================================================================

Action: 32 slots in [-1, 1], times ``ACTION_UNIT`` the action of the task; absent slots are ignored.
``info["critic"]`` is the privileged observation. Seeds: ``reset(seed=s)`` makes everything that follows a function of
``s`` and the actions; ``reset()`` starts new episodes and goes on drawing from the same streams.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict

from eagle_rl.config.schema import AidsCfg, CommandCurriculumCfg, CommandsCfg, ObservationsCfg, RewardsCfg, TaskCfg
from eagle_rl.errors import ConfigError

from .humanoid_env import HumanoidEnv
from .mdp.layout import ObservationLayout
from .pooling import share
from .rendering.offscreen import Frame, OffscreenRenderer
from .rendering.scene import Stage
from .robots.load import load_robot
from .robots.slots import NUM_SLOTS

OBSERVATION_GROUPS = ("history", "command", "clock", "slot_mask")
ENV_ID = "eagle/Humanoid-v0"
DEFAULT_TASK = TaskCfg(
    aids=AidsCfg(harness=0.0, gait_shaping=0.0),
    rewards=RewardsCfg(penalty_initial=1.0),
    commands=CommandsCfg(curriculum=CommandCurriculumCfg(enabled=False)),
)
"""The task without learning aids and curricula, so that it is the same whenever it is built anew."""
ACTION_UNIT = 4.0
"""Task action at the bound of the action space [-]: about 1 rad of PD target."""

Array = NDArray[np.float32]
Observation = dict[str, Array]
_FPS = 50


def observation_space(cfg: ObservationsCfg) -> spaces.Dict:
    """What the actor sees of one robot."""
    layout = ObservationLayout(cfg)

    def box(group: str, bound: float) -> spaces.Box:
        return spaces.Box(-bound, bound, (layout.size(group),), np.float32)

    mask = spaces.Box(0.0, 1.0, (NUM_SLOTS,), np.float32)
    boxes = (box("history", cfg.clip), box("command", cfg.clip), box("clock", 1.0), mask)
    return spaces.Dict(dict(zip(OBSERVATION_GROUPS, boxes, strict=True)))


def action_space() -> spaces.Box:
    """Normalised actions of one robot in slots."""
    return spaces.Box(-1.0, 1.0, (NUM_SLOTS,), np.float32)


def _observation(groups: TensorDict) -> Observation:
    """Copies, which stay as they are when the environment moves on."""
    return {name: groups[name].numpy().copy() for name in OBSERVATION_GROUPS}


class _Simulation:
    """The pooled task, built anew for every seed."""

    def __init__(self, robots: Sequence[str], task: TaskCfg | None, num_envs: int, num_threads: int) -> None:
        self.specs = [load_robot(name) for name in robots]
        self.task = task or DEFAULT_TASK
        self.num_envs, self.num_threads = num_envs, num_threads
        self._env: HumanoidEnv | None = None

    @property
    def env(self) -> HumanoidEnv:
        """The task.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self._env is None:
            raise ResetNeeded("call env.reset() before env.step()")
        return self._env

    @torch.inference_mode(False)  # what is written in place must not be an inference tensor
    def reset(self, seed: int | None, generator: np.random.Generator) -> TensorDict:
        """Start new episodes; with a seed, or the first time, also new random streams."""
        if seed is not None or self._env is None:
            stream = int(generator.integers(2**31))
            self._env = HumanoidEnv(self.task, self.specs, self.num_envs, stream, num_threads=self.num_threads)
            self._env.final_of_episodes = True
        else:
            self._env.reset()
        return self.env.get_observations()

    @torch.inference_mode(False)
    def step(self, actions: Array) -> tuple[TensorDict, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Observations after resets, rewards, terminations, truncations, extras."""
        groups, rewards, dones, extras = self.env.step(ACTION_UNIT * torch.as_tensor(actions))
        truncations = extras["time_outs"]
        return groups, rewards.numpy(), (dones & ~truncations).numpy(), truncations.numpy(), extras


class HumanoidGymEnv(gymnasium.Env[Any, Any]):
    """One robot."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": _FPS}  # noqa: RUF012 (gymnasium's own shape)

    def __init__(
        self, robots: Sequence[str] = ("g1",), task: TaskCfg | None = None, render_mode: str | None = None
    ) -> None:
        """Describe the environment; it is built by the first reset.

        Args:
            robots: one robot, by name or by the path of its YAML file.
            task: the Markov decision process, :data:`DEFAULT_TASK` unless given.
            render_mode: ``rgb_array`` or None.
        """
        if len(robots) != 1 or isinstance(robots, str):
            raise ConfigError(f"robots: got {robots!r}, expected one robot in a list; for several use make_vec.")
        self.render_mode = render_mode
        self._sim = _Simulation(robots, task, num_envs=1, num_threads=1)
        self.observation_space = observation_space(self._sim.task.observations)
        self.action_space = action_space()
        self._renderer: OffscreenRenderer | None = None
        self._pose: NDArray[np.float64] | None = None
        """In which the episode ended, if it did: the simulation has begun the next one."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode."""
        super().reset(seed=seed)
        self._pose = None
        return self._row(self._sim.reset(seed, self.np_random))

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance 0.02 s; after the end of an episode the observation is the true last one."""
        groups, rewards, terminations, truncations, extras = self._sim.step(action[None])
        ended = bool(terminations[0] or truncations[0])
        self._pose = extras["final_poses"][0] if ended else None
        observation, info = self._row(extras["final_observations"] if ended else groups)
        return observation, float(rewards[0]), bool(terminations[0]), bool(truncations[0]), info

    def render(self) -> Frame | None:
        """A picture, RGB, if the render mode asks for one."""
        if self.render_mode != "rgb_array":
            return None
        if self._renderer is None:
            self._renderer = OffscreenRenderer(Stage(self._sim.specs), 640, 480)
        self._renderer.show([self._sim.env.pool.batches[0].qpos[0] if self._pose is None else self._pose])
        return self._renderer.frame()

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _row(self, groups: TensorDict) -> tuple[Observation, dict[str, Any]]:
        return _observation(groups[0]), {"critic": groups["critic"][0].numpy().copy()}


class HumanoidVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Several robots in one pool, ``num_envs`` shared equally among them; resets in the same step."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012 (gymnasium's own shape)

    def __init__(
        self,
        num_envs: int = 5,
        robots: Sequence[str] = ("h1", "g1", "t1", "n1", "adam"),
        task: TaskCfg | None = None,
        num_threads: int = 0,
    ) -> None:
        """Describe the environments; they are built by the first reset.

        Args:
            num_envs: environments over all robots, N; ``gymnasium.make_vec`` says 1 unless told otherwise.
            robots: robots by name or by the path of a YAML file.
            task: the Markov decision process, :data:`DEFAULT_TASK` unless given.
            num_threads: physics threads, 0 for one per core.
        """
        share(num_envs, len(robots))  # refused here already, if they are too few
        self.num_envs = num_envs
        self._sim = _Simulation(robots, task, num_envs, num_threads)
        self.single_observation_space = observation_space(self._sim.task.observations)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes everywhere."""
        super().reset(seed=seed)
        groups = self._sim.reset(seed, self.np_random)
        return _observation(groups), self._info(groups)

    def step(self, actions: Array) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Advance 0.02 s; ``info["final_obs"]`` holds the true last observations of episodes that ended."""
        groups, rewards, terminations, truncations, extras = self._sim.step(actions)
        info = self._info(groups)
        if len(extras["final_ids"]):
            info |= self._final(extras["final_observations"], extras["final_ids"].numpy())
        return _observation(groups), rewards, terminations, truncations, info

    def _info(self, groups: TensorDict) -> dict[str, Any]:
        return {"critic": groups["critic"].numpy().copy(), "_critic": np.ones(self.num_envs, dtype=bool)}

    def _final(self, groups: TensorDict, ids: NDArray[np.int64]) -> dict[str, Any]:
        """Last observations in gymnasium's form: one entry per environment and a mask."""
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[ids] = True
        observations = np.full(self.num_envs, None, dtype=object)
        for row, env in enumerate(ids):
            observations[env] = _observation(groups[row])
        critic = np.zeros((self.num_envs, groups["critic"].shape[1]), np.float32)
        critic[ids] = groups["critic"].numpy()
        return {
            "final_obs": observations,
            "_final_obs": mask,
            "final_info": {"critic": critic, "_critic": mask},
            "_final_info": mask,
        }


gymnasium.register(ENV_ID, entry_point=f"{__name__}:HumanoidGymEnv", vector_entry_point=f"{__name__}:HumanoidVectorEnv")
