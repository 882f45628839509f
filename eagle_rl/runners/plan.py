"""Algorithm 1 of the paper as data: which stages an experiment consists of, what each starts from and what it costs.

Line 1 of the algorithm is the stage ``generalist`` (or ``root``, when the experiment forks from a checkpoint); lines
3-4 are ``roundR/specialist_ROBOT``; lines 5-9 are ``roundR/distill``. Nothing here imports torch.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from eagle_rl.config.schema import ExperimentCfg, TaskCfg
from eagle_rl.errors import ConfigError

Kind = Literal["root", "generalist", "continued", "specialist", "distill"]
Imitation = Literal["eagle", "kickstart"]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One training run of the plan."""

    name: str
    kind: Kind
    round: int
    """0 before the first round of specialise and generalise."""
    robots: tuple[str, ...]
    env_steps: int
    """Budget; one robot, one 50 Hz control step is 1."""
    iterations: int
    """The budget in whole learning iterations, rounded up."""
    init: str | None = None
    """Stage whose final weights this one starts from."""
    teachers: tuple[str, ...] = ()
    """Specialist stage of each robot, in the order of ``robots``."""
    imitation: Imitation | None = None
    seed: int

    @property
    def inputs(self) -> tuple[str, ...]:
        """Stages that must be done first."""
        return (*(() if self.init is None else (self.init,)), *self.teachers)

    @property
    def warm(self) -> bool:
        """Whether the policy has been through the curriculum already."""
        return self.init is not None


def warm_task(task: TaskCfg) -> TaskCfg:
    """The task of a stage that starts from a trained policy: finishing ranges, whole penalties, no aids."""
    return replace(
        task,
        commands=replace(task.commands, curriculum=replace(task.commands.curriculum, enabled=False)),
        rewards=replace(task.rewards, penalty_initial=1.0),
        aids=replace(task.aids, harness=0.0, gait_shaping=0.0),
    )


def _stage(cfg: ExperimentCfg, name: str, kind: Kind, env_steps: int, **rest: object) -> Stage:
    """A stage with its budget in iterations and a seed of its own."""
    fields = {
        "round": 0,
        "robots": cfg.robots,
        "iterations": -(-env_steps // (cfg.num_envs * cfg.algo.num_steps_per_env)),
        "seed": zlib.crc32(f"{cfg.seed}/{name}".encode()) >> 1,
    }
    return Stage(name=name, kind=kind, env_steps=env_steps, **{**fields, **rest})  # type: ignore[arg-type]


def _round(cfg: ExperimentCfg, number: int, generalist: str) -> list[Stage]:
    """Specialists and distillation of one round (lines 3-9)."""
    plan = cfg.plan
    specialists = [
        _stage(
            cfg,
            f"round{number}/specialist_{Path(robot).stem}",
            "specialist",
            plan.specialist_env_steps,
            round=number,
            robots=(robot,),
            init=generalist,
        )
        for robot in cfg.robots
    ]
    distill = _stage(
        cfg,
        f"round{number}/distill",
        "distill",
        plan.distill_env_steps,
        round=number,
        init=generalist,
        teachers=tuple(stage.name for stage in specialists),
        imitation="kickstart" if plan.method == "kickstarting" else "eagle",
    )
    return [*specialists, distill]


def plan_stages(cfg: ExperimentCfg, processes: int = 1) -> list[Stage]:
    """Every stage the experiment may run, in order; rounds after convergence are left out while running.

    With several data-parallel ``processes``, each of which has all of ``num_envs``, budgets take fewer iterations.
    """
    cfg = replace(cfg, num_envs=cfg.num_envs * processes)
    plan = cfg.plan
    if plan.method == "compass":
        raise ConfigError("plan.method: compass is not built; choose ppo, eagle or kickstarting.")
    if plan.root is None:
        stages = [_stage(cfg, "generalist", "generalist", plan.generalist_env_steps)]
    else:
        stages = [_stage(cfg, "root", "root", 0)]
    if plan.method == "ppo":
        if plan.root is not None:
            stages.append(_stage(cfg, "continued", "continued", plan.generalist_env_steps, init="root"))
        return stages
    for number in range(1, plan.max_rounds + 1):
        generalist = stages[-1].name
        stages += _round(cfg, number, generalist)
    return stages
