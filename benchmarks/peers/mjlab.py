"""mjlab: its PPO on ``Mjlab-Velocity-Flat-Unitree-G1``, by MuJoCo Warp on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version

import mjlab.tasks  # noqa: F401, registers them
import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

from .turns import About, Rates, Setting, Stepping, Training, control, serve

TASK = "Mjlab-Velocity-Flat-Unitree-G1"


def prepare(setting: Setting) -> tuple[About, Callable[[], Rates]]:
    """The task and its learner, as configured by default."""
    cfg, agent = load_env_cfg(TASK), load_rl_cfg(TASK)
    cfg.scene.num_envs = setting.num_envs
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg=cfg, device="cpu"), clip_actions=agent.clip_actions)
    runner = MjlabOnPolicyRunner(env, asdict(agent), None, "cpu")
    training = Training(runner, agent.num_steps_per_env, setting)

    def step() -> None:
        with torch.inference_mode():
            env.step(0.3 * torch.randn(env.num_envs, env.num_actions))

    stepping = Stepping(step, setting)
    algorithm = agent.algorithm
    about = About(
        versions=f"mjlab {version('mjlab')}, mujoco-warp {version('mujoco-warp')}, Warp {version('warp-lang')}, "
        f"torch {version('torch')}",
        control=control(cfg.decimation, cfg.sim.mujoco.timestep),
        threads=f"1 of Warp's kernels, {torch.get_num_threads()} of torch",
        differs=f"{algorithm.num_learning_epochs} epochs of {algorithm.num_mini_batches} batches; actor "
        f"{list(agent.actor.hidden_dims)} and critic {list(agent.critic.hidden_dims)}, no other networks; randomizes "
        "friction, a centre of mass, encoders and pushes; made for an NVIDIA GPU; nothing holds it upright",
    )
    return about, lambda: stepping.rates() | training.rates()


if __name__ == "__main__":
    serve(prepare)
