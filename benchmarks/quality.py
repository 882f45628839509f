"""Time and environment steps until a policy is good, which is what speed is for: ``eagle bench quality``."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from eagle_rl.cli.environment import make_env_factory
from eagle_rl.config.load import load_experiment
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.evaluation.evaluate import evaluate
from eagle_rl.machine import own_cores
from eagle_rl.models.precision import set_up_torch
from eagle_rl.runners.checkpoint import latest_checkpoint
from eagle_rl.runners.compiling import compile_where_it_pays
from eagle_rl.runners.on_policy import EagleRunner, make_train_cfg
from eagle_rl.runners.provenance import Provenance

from .measure import Figure

MIN_SURVIVAL = 0.95
"""Share of environments that stay up for the 20 s of the protocol [-]."""
MAX_ERROR_VX = 0.2
"""Mean error of the forward velocity [m/s]."""
ENV_STEPS_PER_ROBOT = 150_000
"""Environment steps of each robot between two looks at the policy, whatever the batch, rounded up to iterations."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One look at the policy."""

    env_steps: int
    seconds: float
    """Spent on training so far, evaluations not included."""
    survival: float
    """Of the robot that falls most [-]."""
    error_vx: float
    """Of the robot that follows worst [m/s]."""

    @property
    def good(self) -> bool:
        """Whether this is the quality asked for."""
        return self.survival >= MIN_SURVIVAL and self.error_vx <= MAX_ERROR_VX


def quality_experiment(num_envs: int, threads: int, overrides: Sequence[str] = ()) -> ExperimentCfg:
    """``ppo`` on G1 alone, or what the overrides make of it, judged by 64 environments a robot."""
    cfg = load_experiment("ppo", ["robots=[g1]", f"num_envs={num_envs}", *overrides])
    evaluation = replace(cfg.evaluation, num_envs_per_robot=cfg.plan.judge_envs_per_robot)
    return replace(cfg, evaluation=evaluation, run=replace(cfg.run, num_threads=threads))


def time_to_quality(
    cfg: ExperimentCfg, folder: Path, minutes: float, env_steps_per_robot: int = ENV_STEPS_PER_ROBOT
) -> list[Figure]:
    """Train until the policy is good with every robot, its budget is spent, or the time is up.

    Args:
        cfg: robots, the budget ``plan.generalist_env_steps``, and the protocol of the checks.
        folder: where checkpoints and ``quality.jsonl`` are; a run that is there is resumed, with the same ``cfg`` only.
        minutes: longest time to go on now, looked at after each check.
        env_steps_per_robot: between checks.
    """
    set_up_torch(cfg.run.torch_threads or own_cores())
    runner = _runner(cfg, folder)
    end = time.monotonic() + 60 * minutes
    iterations = math.ceil(env_steps_per_robot * len(cfg.robots) / (cfg.num_envs * cfg.algo.num_steps_per_env))
    record = folder / "quality.jsonl"
    lines = record.read_text().splitlines() if record.exists() else []
    checks = [check for check in (Check(**json.loads(line)) for line in lines) if check.env_steps <= runner.env_steps]
    while not (checks and checks[-1].good) and runner.env_steps < cfg.plan.generalist_env_steps:
        runner.learn(iterations)
        checks.append(_check(runner, cfg))
        record.write_text("".join(json.dumps(asdict(check)) + "\n" for check in checks))
        if time.monotonic() > end:
            break
    return _figures(checks[-1])


def _runner(cfg: ExperimentCfg, folder: Path) -> EagleRunner:
    env = make_env_factory(cfg.run)(cfg.robots, cfg.num_envs, cfg.task, cfg.seed)
    history = cfg.task.observations.history_length
    train_cfg = make_train_cfg(cfg.algo, cfg.run, history_length=history, seed=cfg.seed)
    runner = EagleRunner(env, train_cfg, folder, cfg.run.device, Provenance(config=asdict(cfg), stage="quality"))
    compile_where_it_pays(env, runner.alg, cfg.run, cfg.plan.generalist_env_steps)
    latest = latest_checkpoint(folder / "checkpoints")
    if latest is not None:
        runner.load(latest)
    return runner


def _check(runner: EagleRunner, cfg: ExperimentCfg) -> Check:
    """Judge the present policy, as the end of a stage does."""
    metrics = evaluate(runner.alg.actor, make_env_factory(cfg.run), cfg.robots, cfg.task, cfg.evaluation).values()
    survival = min(robot.survival for robot in metrics)
    # A robot that was not up for a single step has no error; its survival says so.
    error = max(robot.subsets["all"].errors[0] or 0.0 for robot in metrics)
    return Check(env_steps=runner.env_steps, seconds=runner.wall_time, survival=survival, error_vx=error)


def _figures(last: Check) -> list[Figure]:
    detail = f"survival {last.survival:.1%}, E_vx {last.error_vx:.3f} m/s"
    detail += "" if last.good else ", NOT YET good: go on with the same --run"
    bar = f"until >= {MIN_SURVIVAL:.0%} and <= {MAX_ERROR_VX} m/s"
    return [
        Figure("training to quality, env steps", last.env_steps / 1e6, "million", bar, detail),
        Figure("training to quality, time", last.seconds, "s", bar, detail),
    ]
