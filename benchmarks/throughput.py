"""Environment steps a second, against the physics alone, and the update against its matrix products."""

from __future__ import annotations

import math
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from statistics import median
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from eagle_rl.algorithms.eagle_ppo import EaglePPO
from eagle_rl.machine import own_cores
from eagle_rl.runners.on_policy import EagleRunner
from eagle_rl.threads import use_threads

from .budget import Budget
from .measure import Figure, in_turns, milliseconds
from .workloads import BarePhysics, Stepping, experiment, make_env, make_runner, step_costs


def environment(num_envs: int, threads: int, seconds: float, bar: str) -> list[Figure]:
    """Rate of the whole environment step as a share of the bare physics' rate: medians, means and by CPU time."""
    cost = step_costs({"pool": make_env(experiment(threads), num_envs)}, seconds)["pool"]
    step, bare = cost.step, cost.bare
    name = f"environment step / bare physics, {num_envs} envs"
    detail = milliseconds(step=step.wall, bare=bare.wall)
    ideal = bare.cpu / threads
    cpu_detail = (
        milliseconds(cpu_step=step.cpu, cpu_bare=bare.cpu) + f", {1e6 * cost.overhead / num_envs:.1f} us an env"
    )
    return [
        Figure(name, bare.wall / step.wall, "x", bar, detail),
        Figure(f"{name}, means", bare.mean / step.mean, "x", bar, milliseconds(step=step.mean, bare=bare.mean)),
        Figure(f"{name}, from CPU time", ideal / (ideal + cost.overhead), "x", bar, cpu_detail),
    ]


def pooling(num_envs: int, threads: int, seconds: float) -> list[Figure]:
    """Five robots pooled against one robot at a time with as many environments: both beside the pool's own physics."""
    cfg = experiment(threads)
    envs = {name: make_env(cfg, num_envs, (name,)) for name in cfg.robots} | {"pool": make_env(cfg, num_envs)}
    costs = step_costs(envs, seconds)
    alone = sum(costs[name].overhead for name in cfg.robots) / len(cfg.robots)
    pool, physics = costs["pool"].overhead, costs["pool"].bare.cpu / threads
    ratio = (physics + alone) / (physics + pool)
    detail = milliseconds(pool_overhead=pool, mean_overhead_alone=alone, physics=physics)
    return [Figure("five robots pooled / one robot, same physics", ratio, "x", ">= 0.95", detail)]


def scaling(num_envs: int, seconds: float) -> list[Figure]:
    """The environment step with two physics threads against one."""
    steps = {str(threads): Stepping(make_env(experiment(threads), num_envs)).step for threads in (1, 2)}
    costs = in_turns(steps, seconds)
    one, two = costs["1"].wall, costs["2"].wall
    return [Figure("environment step, 2 threads / 1 thread", one / two, "x", ">= 1.7", milliseconds(one=one, two=two))]


Product = tuple[int, int, int, torch.dtype]
"""Rows, inner dimension, columns and precision of a matrix product."""


class _Products(TorchDispatchMode):
    """Counts the matrix products that are computed."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[Product] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in (torch.ops.aten.mm.default, torch.ops.aten.addmm.default):
            a, b = args[-2:]
            self.counts[(a.shape[0], a.shape[1], b.shape[1], a.dtype)] += 1
        return func(*args, **(kwargs or {}))


class _Multiplying:
    """The matrix products of an update, and nothing else, by as many threads as the learner has."""

    def __init__(self, products: Counter[Product], threads: int) -> None:
        self._work = [
            (torch.randn(m, k).to(dtype), torch.randn(k, n).to(dtype), count)
            for (m, k, n, dtype), count in (_part(product, threads) for product in products.items())
        ]
        self._pool = ThreadPoolExecutor(threads, initializer=torch.get_num_threads)
        self._threads = threads
        self.flops = sum(2.0 * m * k * n * count for (m, k, n, _), count in products.items())

    def multiply(self) -> None:
        list(self._pool.map(lambda _: self._multiply_part(), range(self._threads)))

    def _multiply_part(self) -> None:
        for a, b, count in self._work:
            for _ in range(count):
                torch.mm(a, b)


def _part(product: tuple[Product, int], threads: int) -> tuple[Product, int]:
    """A thread's part of a product that is computed so many times: its longest side is shared out."""
    (*sides, dtype), count = product
    longest = sides.index(max(sides))
    m, k, n = (math.ceil(side / threads) if i == longest else side for i, side in enumerate(sides))
    return (m, k, n, dtype), count


def _products_of_update(runner: EagleRunner) -> _Multiplying:
    """Train for an iteration by the code as it is, whose products can be seen, in the only thread that sees them."""
    counted, update = _Products(), runner.alg.update

    def counting() -> dict[str, float]:
        with counted:
            return update()

    use_threads(1)
    runner.alg.update = counting  # type: ignore[method-assign]
    runner.learn(1)
    del runner.alg.update
    use_threads(own_cores())
    return _Multiplying(counted.counts, own_cores())


def iteration(num_envs: int, threads: int, iterations: int) -> list[Figure]:
    """Whole iterations, in turns with the bare physics and the bare matrix products of as much work."""
    cfg = experiment(threads)
    env = make_env(cfg, num_envs)
    runner, bare = make_runner(cfg, env), BarePhysics(env)
    products = _products_of_update(runner)
    runner.alg.compile_from = 0
    budget, wall = Budget(), []
    for owner, method, section in (
        (EaglePPO, "update", "update"),
        (bare, "step", "bare"),
        (bare, "remember", "bookkeeping"),
        (bare, "remember_targets", "bookkeeping"),
        (bare, "rewind", "bookkeeping"),
        (bare, "return_to_present", "bookkeeping"),
        (products, "multiply", "products"),
    ):
        budget.watch(owner, method, section, whole=True)
    step = env.step

    def remembered(actions: torch.Tensor) -> Any:
        bare.remember()
        outcome = step(actions)
        bare.remember_targets()
        return outcome

    env.step = remembered  # type: ignore[method-assign]

    def turn(_: int) -> None:
        for _ in range(cfg.algo.num_steps_per_env):
            bare.rewind()
            bare.step()
        bare.return_to_present()
        products.multiply()
        wall.append(dict(budget.wall))

    with budget:
        runner.learn(iterations + 1, on_iteration=turn)
    env_steps = cfg.algo.num_steps_per_env * num_envs
    return _iteration_figures(num_envs, env_steps, _medians(wall), products.flops)


def _medians(books: list[dict[str, float]]) -> dict[str, float]:
    """Median of what each section gained from one entry to the next."""
    rounds = [{name: after[name] - before[name] for name in after} for before, after in pairwise(books)]
    return {name: median(r[name] for r in rounds) for name in ("other", "update", "bare", "products")}


def _iteration_figures(num_envs: int, env_steps: int, times: dict[str, float], flops: float) -> list[Figure]:
    collection, update, bare, products = (times[name] for name in ("other", "update", "bare", "products"))
    whole = collection + update
    detail = milliseconds(collection=collection, update=update, bare=bare)
    rate = f"{flops / products / 1e9:.0f} GFLOP/s alone, {flops / env_steps / 1e6:.1f} MFLOP an env-step"
    return [
        Figure(f"collection / bare physics, {num_envs} envs", bare / collection, "x", ">= 0.70", detail),
        Figure("whole iteration / bare physics", bare / whole, "x", ">= 0.35", f"{env_steps / whole:.0f} env-steps/s"),
        Figure("update's share of the iteration", update / whole, "share", "<= 0.50", ""),
        Figure("matrix products' share of the update", products / update, "share", ">= 0.80", rate),
    ]
