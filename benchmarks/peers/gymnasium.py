"""Gymnasium: its ``Humanoid-v5`` with our G1 for a robot, in one of its vector environments."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version

import gymnasium as gym
import mujoco
import numpy as np

from .turns import About, Rates, Setting, Stepping, control, serve

PROCESSES = {"AsyncVectorEnv": "a process each environment", "SyncVectorEnv": "1"}


def prepare(setting: Setting) -> tuple[About, Callable[[], Rates]]:
    """The vector environment that is the setting's variant."""

    def make() -> gym.Env:
        return gym.make(
            "Humanoid-v5",
            xml_file=setting.model,
            frame_skip=setting.decimation,
            healthy_z_range=(0.4, 2.0),
        )

    env = getattr(gym.vector, setting.variant)([make] * setting.num_envs)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    stepping = Stepping(lambda: env.step(0.075 * rng.standard_normal(env.action_space.shape)), setting)
    about = About(
        versions=f"Gymnasium {version('gymnasium')}, MuJoCo {version('mujoco')}",
        control=control(setting.decimation, mujoco.MjModel.from_xml_path(setting.model).opt.timestep),
        threads=PROCESSES[setting.variant],
        differs="our G1's model in `Humanoid-v5`: its observations and rewards, without history, commands, curriculum "
        "or randomization; nothing holds it upright; no learner",
    )
    return about, stepping.rates


if __name__ == "__main__":
    serve(prepare)
