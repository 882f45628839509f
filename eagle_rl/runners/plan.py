"""Algorithm 1 of the paper as data: which stages an experiment consists of, what each starts from and what it costs.

Line 1 of the algorithm is the stage ``generalist`` (or ``root``, when the experiment forks from a checkpoint); lines
3-4 are ``roundR/specialist_ROBOT`` and, ours, ``roundR/search_ROBOT`` and ``roundR/correct_ROBOT``, or
``round1/teacher_ROBOT`` where there is a specialist already; lines 5-9 are
``roundR/distill`` and, ours, ``roundR/average``. Nothing here imports torch.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from eagle_rl.config.schema import ExperimentCfg, TaskCfg

Kind = Literal[
    "root",
    "generalist",
    "continued",
    "specialist",
    "search",
    "correct",
    "teacher",
    "distill",
    "average",
    "base",
    "residual",
]
Imitation = Literal["eagle", "kickstart"]

RESIDUAL = "compass/residual_"
"""What the name of a COMPASS specialist's stage begins with."""

TEACHERS = ("specialist", "generalist")
"""What ``plan.teachers`` may name beside files."""

ALONE: tuple[Kind, ...] = ("specialist", "search", "correct", "teacher", "residual")
"""What is for one robot."""


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
    """The budget in whole learning iterations, generations of a search or probes of a correction, rounded up."""
    init: str | None = None
    """Stage whose final weights this one starts from."""
    source: str | None = None
    """File of the specialist that a ``teacher`` is."""
    teachers: tuple[str, ...] = ()
    """The stage whose policy teaches each robot, in the order of ``robots``."""
    imitation: Imitation | None = None
    start: str | None = None
    """Stage whose weights those of ``init`` are averaged with."""
    base: str | None = None
    """Stage whose policy's actions the specialists' are added to (COMPASS)."""
    critic: str | None = None
    """Stage whose critic and learning rate a residual begins with: PPO's last, a base that imitates learns neither."""
    demonstrations: bool = False
    """Whether the teachers act instead of the policy, and nothing but imitation is learned (COMPASS)."""
    world_model: bool = False
    """Whether the estimator also predicts the next frame (COMPASS)."""
    seed: int

    @property
    def inputs(self) -> tuple[str, ...]:
        """Stages that must be done first."""
        return tuple(
            dict.fromkeys(
                name for name in (self.init, self.start, self.base, self.critic, *self.teachers) if name is not None
            )
        )

    @property
    def warm(self) -> bool:
        """Whether the curricula have been passed before."""
        return self.kind != "generalist"

    @property
    def position(self) -> float:
        """Where its policy stands among the rounds: specialists before the generalist they teach, an average after."""
        before = {"specialist": 0.5, "residual": 0.5, "teacher": 0.5, "search": 0.25, "correct": 0.15, "average": -0.2}
        return self.round - before.get(self.kind, 0.0)

    @property
    def specialised(self) -> bool:
        """Whether it ends with a policy for one robot."""
        return self.kind in ALONE


def warm_task(task: TaskCfg) -> TaskCfg:
    """The task of a stage that starts from a trained policy: finishing ranges, whole penalties, no aids."""
    return replace(
        task,
        commands=replace(task.commands, curriculum=replace(task.commands.curriculum, enabled=False)),
        rewards=replace(task.rewards, penalty_initial=1.0),
        aids=replace(task.aids, harness=0.0, gait_shaping=0.0),
    )


def stage_num_envs(cfg: ExperimentCfg, kind: Kind) -> int:
    """Environments of a stage."""
    return (cfg.plan.specialist_num_envs if kind in ALONE else 0) or cfg.num_envs


def _stage(cfg: ExperimentCfg, name: str, kind: Kind, env_steps: int, **rest: object) -> Stage:
    """A stage with its budget in iterations and a seed of its own."""
    if kind == "search":
        steps = 2 * cfg.search.num_pairs * cfg.search.num_steps
    elif kind == "correct":
        steps = 3 * cfg.correction.num_envs * cfg.correction.num_steps
    else:
        steps = stage_num_envs(cfg, kind) * cfg.algo.num_steps_per_env
    fields = {
        "round": 0,
        "robots": cfg.robots,
        "iterations": -(-env_steps // steps),
        "seed": zlib.crc32(f"{cfg.seed}/{name}".encode()) >> 1,
    }
    return Stage(name=name, kind=kind, env_steps=env_steps, **{**fields, **rest})  # type: ignore[arg-type]


def _teacher(cfg: ExperimentCfg, number: int, robot: str, generalist: str, teacher: str) -> list[Stage]:
    """The stages whose last one teaches a robot; none where the generalist does."""
    if teacher == "generalist":
        return []
    if teacher != "specialist":
        name = f"round{number}/teacher_{Path(robot).stem}"
        return [_stage(cfg, name, "teacher", 0, round=number, robots=(robot,), source=teacher)]
    return _specialist(cfg, number, robot, generalist)


def _specialist(cfg: ExperimentCfg, number: int, robot: str, generalist: str) -> list[Stage]:
    """Training, search and correction of one specialist, whichever of them has a budget."""
    budgets: dict[Kind, int] = {
        "specialist": cfg.plan.specialist_env_steps,
        "search": cfg.plan.search_env_steps,
        "correct": cfg.plan.correction_env_steps,
    }
    stages: list[Stage] = []
    for kind, budget in budgets.items():
        if budget:
            name, init = f"round{number}/{kind}_{Path(robot).stem}", stages[-1].name if stages else generalist
            stages.append(_stage(cfg, name, kind, budget, round=number, robots=(robot,), init=init))
    return stages


def _round(cfg: ExperimentCfg, number: int, generalist: str) -> list[Stage]:
    """Specialists and distillation of one round (lines 3-9)."""
    named = cfg.plan.teachers if number == 1 else ()
    pairs = zip(cfg.robots, named or ("specialist",) * len(cfg.robots), strict=True)
    specialists = [_teacher(cfg, number, robot, generalist, teacher) for robot, teacher in pairs]
    distill = _stage(
        cfg,
        f"round{number}/distill",
        "distill",
        cfg.plan.distill_env_steps,
        round=number,
        init=generalist,
        teachers=tuple(stages[-1].name if stages else generalist for stages in specialists),
        imitation="kickstart" if cfg.plan.method == "kickstarting" else "eagle",
    )
    average = _stage(cfg, f"round{number}/average", "average", 0, round=number, init=distill.name, start=generalist)
    ends = [distill, average] if cfg.plan.start_share else [distill]
    return [*(stage for stages in specialists for stage in stages), *ends]


def _compass(cfg: ExperimentCfg, demonstrator: str) -> list[Stage]:
    """The stages of COMPASS after its demonstrator, who is the base where nothing is spent on imitating it."""
    plan = cfg.plan
    imitates = plan.base_env_steps > 0
    imitation: dict[str, object] = {
        "round": 1,
        "imitation": "kickstart",
        "demonstrations": True,
        "world_model": imitates,
    }
    base = _stage(
        cfg, "compass/base", "base", plan.base_env_steps, teachers=(demonstrator,) * len(cfg.robots), **imitation
    )
    origin = base.name if imitates else demonstrator
    residuals = [
        _stage(
            cfg,
            f"{RESIDUAL}{Path(robot).stem}",
            "residual",
            plan.specialist_env_steps,
            round=1,
            robots=(robot,),
            base=origin,
            critic=demonstrator,
        )
        for robot in cfg.robots
    ]
    teachers = tuple(stage.name for stage in residuals)
    distill = _stage(
        cfg,
        "compass/distill",
        "distill",
        plan.distill_env_steps,
        init=origin,
        base=origin,
        teachers=teachers,
        **imitation,
    )
    return [*([base] if imitates else []), *residuals, distill]


def plan_stages(cfg: ExperimentCfg, processes: int = 1) -> list[Stage]:
    """Every stage the experiment may run, in order; rounds after convergence are left out while running.

    With several data-parallel ``processes``, each of which has all of ``num_envs``, budgets take fewer iterations.
    """
    plan = replace(cfg.plan, specialist_num_envs=cfg.plan.specialist_num_envs * processes)
    cfg = replace(cfg, num_envs=cfg.num_envs * processes, plan=plan)
    if plan.root is None:
        stages = [_stage(cfg, "generalist", "generalist", plan.generalist_env_steps)]
    else:
        stages = [_stage(cfg, "root", "root", 0)]
    if plan.method == "ppo":
        if plan.root is not None:
            stages.append(_stage(cfg, "continued", "continued", plan.generalist_env_steps, init="root"))
            if plan.start_share:
                stages.append(_stage(cfg, "averaged", "average", 0, init="continued", start="root"))
        return stages
    if plan.method == "compass":
        return [*stages, *_compass(cfg, stages[0].name)]
    for number in range(1, plan.max_rounds + 1):
        generalist = stages[-1].name
        stages += _round(cfg, number, generalist)
    return stages
