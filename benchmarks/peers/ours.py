"""Us: ``ppo`` on G1 alone, compiled as a long run is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from benchmarks.workloads import experiment, make_env, make_runner
from eagle_rl.machine import usable_cores
from eagle_rl.models.precision import multiplies_in_bfloat16
from eagle_rl.runners.provenance import versions

from .turns import About, Rates, Setting, Stepping, Training, control, serve


def prepare(setting: Setting) -> tuple[About, Callable[[], Rates]]:
    """The environment in the middle of training, and its learner."""
    cores = usable_cores()
    cfg = replace(experiment(cores), robots=("g1",))
    env = make_env(cfg, setting.num_envs)
    runner = make_runner(cfg, env)
    runner.alg.compile_from = 0
    training = Training(runner, cfg.algo.num_steps_per_env, setting)

    def step() -> None:
        with torch.no_grad():  # the learner goes on with these tensors, which inference mode would not allow
            env.step(0.3 * torch.randn(env.num_envs, env.num_actions))

    stepping = Stepping(step, setting)
    net, sim = cfg.algo.network, cfg.task.sim
    precision = "bfloat16" if multiplies_in_bfloat16(cfg.algo.precision, "cpu") else "float32"
    about = About(
        versions=f"MuJoCo {versions()['mujoco']}, torch {versions()['torch']}",
        control=control(sim.decimation, sim.physics_dt),
        threads=f"{cores} of physics, {cores} of the learner",
        differs=f"{cfg.algo.num_learning_epochs} epochs of {cfg.algo.num_mini_batches} batches in {precision}; actor "
        f"{net.actor_dims} with encoder {net.encoder_dims} and estimator {net.estimator_dims}, critic "
        f"{net.critic_dims}, mirror loss; everything randomized; beginners held by a harness; compiled",
    )
    return about, lambda: stepping.rates() | training.rates()


if __name__ == "__main__":
    serve(prepare)
