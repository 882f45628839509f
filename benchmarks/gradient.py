"""How noisy the gradient is that PPO learns from: ``python -m benchmarks.gradient CKPT``.

The policy acts with its exploration noise, nothing is learned, and the gradient of PPO's surrogate loss is taken on
disjoint batches. With tr the variance of a sample's gradient, summed over parameters, and G its mean, tr / |G|^2 is the
number of samples at which a batch is half signal and half noise (McCandlish et al., arXiv 1812.06162). Learning is
drift among noise as long as batches are much smaller.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from eagle_rl.cli.environment import make_env_factory
from eagle_rl.cli.policy import load_policy
from eagle_rl.models.precision import set_up_torch
from eagle_rl.runners.on_policy import EagleRunner
from eagle_rl.runners.plan import warm_task

from .workloads import SEED, make_runner

_WARM_UP = 10
"""Rollouts thrown away, until episodes have all ages."""


def collect(runner: EagleRunner) -> None:
    """One rollout into the storage."""
    obs = runner.env.get_observations()
    with torch.no_grad():
        for _ in range(runner.alg.storage.num_transitions_per_env):
            obs, rewards, dones, extras = runner.env.step(runner.alg.act(obs))
            runner.alg.process_env_step(obs, rewards, dones, extras)


def advantages(runner: EagleRunner, lam: float) -> Tensor:
    """Advantages of the rollout with another trace, not normalized, shape (T, N)."""
    alg = runner.alg
    alg.lam = lam
    with torch.no_grad():
        alg.compute_returns(runner.env.get_observations())
    return (alg.storage.returns - alg.storage.values).squeeze(-1)


def gradients(runner: EagleRunner, lams: Sequence[float], envs_per_batch: int) -> dict[float, list[Tensor]]:
    """Gradient of the surrogate loss by trace, one for each batch of ``envs_per_batch`` environments of every robot."""
    alg, storage = runner.alg, runner.alg.storage
    by_lam = {lam: advantages(runner, lam) for lam in lams}
    order = runner.env.get_observations()["robot"].argsort(stable=True).view(len(alg.robot_names), -1)
    parameters = list(alg.actor.parameters())
    found: dict[float, list[Tensor]] = {lam: [] for lam in lams}
    for columns in order.split(envs_per_batch, dim=1):
        rows = columns.flatten()
        obs, actions = storage.observations[:, rows].flatten(0, 1), storage.actions[:, rows].flatten(0, 1)
        alg.actor(obs, stochastic_output=True)
        log_prob = alg.actor.get_output_log_prob(actions)
        for lam, values in by_lam.items():
            advantage = values[:, rows] - values[:, rows].mean()
            loss = -(log_prob * advantage.flatten()).mean()
            grads = torch.autograd.grad(loss, parameters, retain_graph=True, allow_unused=True)
            found[lam].append(torch.cat([g.flatten() for g in grads if g is not None]))
    storage.clear()
    return found


def noise_scale(found: Sequence[Tensor], batch: int) -> tuple[float, float, float]:
    """tr, |G|^2 (unbiased) and their ratio in samples, from the gradients of batches of ``batch`` samples."""
    stacked = torch.stack(list(found)).double()
    scatter = stacked.var(dim=0).sum().item()
    mean = stacked.mean(dim=0).square().sum().item() - scatter / len(stacked)
    return scatter * batch, mean, scatter * batch / mean if mean > 0 else float("inf")


def main(argv: Sequence[str] | None = None) -> None:
    """Measure and print a line for each trace."""
    parser = argparse.ArgumentParser(description="How noisy PPO's gradient is at a checkpoint.")
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--envs", type=int, default=1280, help="a multiple of 64 times the number of robots [1280]")
    parser.add_argument("--rollouts", type=int, default=10)
    parser.add_argument("--lam", type=float, nargs="+", default=[0.95, 0.9, 0.8])
    args = parser.parse_args(argv)
    set_up_torch(1)
    policy = load_policy(args.checkpoint)
    cfg = replace(policy.cfg, task=warm_task(policy.cfg.task), algo=replace(policy.cfg.algo, precision="float32"))
    robots = len(cfg.robots)
    if args.envs <= 0 or args.envs % (64 * robots):
        parser.error(f"--envs: got {args.envs}, expected a multiple of {64 * robots} for {robots} robots")
    runner = make_runner(cfg, make_env_factory(cfg.run)(cfg.robots, args.envs, cfg.task, SEED))
    runner.alg.load(torch.load(policy.checkpoint, weights_only=True)["algorithm"], {"actor": True, "critic": True})
    for _ in range(_WARM_UP):
        collect(runner)
        runner.alg.storage.clear()
    found: dict[float, list[Tensor]] = {lam: [] for lam in args.lam}
    for _ in range(args.rollouts):
        collect(runner)
        for lam, grads in gradients(runner, args.lam, 64).items():
            found[lam] += grads
    batch = 64 * robots * cfg.algo.num_steps_per_env
    for lam, grads in found.items():
        scatter, mean, samples = noise_scale(grads, batch)
        half = f"half noise at {samples:.3g} samples" if mean > 0 else "mean not resolved: more --rollouts"
        print(f"lambda {lam}: tr {scatter:.3g}, |G|^2 {mean:.3g}, {half}; {len(grads)} batches of {batch}")


if __name__ == "__main__":
    main()
