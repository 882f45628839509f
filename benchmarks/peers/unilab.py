"""UniLab: its PPO on its ``g1_walk_flat`` with MuJoCo, as its ``train`` builds them."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import unilab
from hydra import compose, initialize_config_dir
from rsl_rl.runners import OnPolicyRunner
from unilab.base.config_adapter import EnvConfigAdapter, create_env
from unilab.rl import RslRlVecEnvAdapter
from unilab.training import algo_config_dict, ensure_registries

from .turns import About, Rates, Setting, Stepping, Training, control, serve

ROOT = Path(unilab.__file__).parent
MESHES = re.compile(r'<mesh [^>]*/>|<geom [^>]*\bmesh="[^>]*/>')
"""They only decorate, and would have to be downloaded."""


def _scene() -> Path:
    """The task's scene without meshes, in the working folder."""
    folder = Path.cwd()
    for name in ("g1.xml", "scene_flat.xml"):
        (folder / name).write_text(MESHES.sub("", (ROOT / "assets/robots/g1" / name).read_text()))
    return folder / "scene_flat.xml"


def _configuration(num_envs: int) -> Any:
    overrides = [f"algo.num_envs={num_envs}", f"env.scene.model_file={_scene()}", "training.device=cpu"]
    with initialize_config_dir(str(ROOT / "conf/ppo"), version_base="1.3"):
        return compose("config", overrides=["task=g1_walk_flat/mujoco", *overrides])


def prepare(setting: Setting) -> tuple[About, Callable[[], Rates]]:
    """The task and its learner, as configured by default."""
    ensure_registries()
    cfg = _configuration(setting.num_envs)
    override = EnvConfigAdapter(cfg, root_dir=Path.cwd(), algo_name="ppo").build_task_env_cfg_override()
    env = RslRlVecEnvAdapter(create_env(cfg, num_envs=setting.num_envs, env_cfg_override=override), device="cpu")
    train_cfg = algo_config_dict(cfg) | {"logger": "none"}
    runner = OnPolicyRunner(env, train_cfg, log_dir=None, device="cpu")
    training = Training(runner, cfg.algo.num_steps_per_env, setting)

    def step() -> None:
        with torch.inference_mode():
            env.step(0.3 * torch.randn(env.num_envs, env.num_actions))

    stepping = Stepping(step, setting)
    algorithm, sim_dt = cfg.algo.algorithm, cfg.env.sim_dt
    about = About(
        versions=f"UniLab {version('unilab')}, MuJoCo {version('mujoco')}, torch {version('torch')}",
        control=control(round(cfg.env.ctrl_dt / sim_dt), sim_dt),
        threads=f"one of physics a core, {torch.get_num_threads()} of torch",
        differs=f"{algorithm.num_learning_epochs} epochs of {algorithm.num_mini_batches} batches; actor "
        f"{cfg.algo.actor.hidden_dims} and critic {cfg.algo.critic.hidden_dims}, no other networks; randomizes gains, "
        "poses and velocities of the start and observation noise only; without its meshes; nothing holds it upright",
    )
    return about, lambda: stepping.rates() | training.rates()


if __name__ == "__main__":
    serve(prepare)
