"""What types cannot say: bounds of single values, order of ranges, and agreement between values."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .schema import CommandRangeCfg, EvaluationCfg, ExperimentCfg, SimCfg

CONTROL_STEP = 0.02
"""Control step of every task [s] (HugWBC 3)."""

Fault = tuple[str, str]
"""Dotted path of the value at fault, and what is wrong with it."""

_Bound = tuple[str, Callable[[float], bool]]
_POSITIVE: _Bound = ("above 0", lambda x: x > 0)
_NOT_NEGATIVE: _Bound = ("0 or more", lambda x: x >= 0)
_SHARE: _Bound = ("from 0 to 1", lambda x: 0 <= x <= 1)
_POSITIVE_SHARE: _Bound = ("above 0 and at most 1", lambda x: 0 < x <= 1)

_WEIGHTS = "task.rewards.weights."

BOUNDS: dict[str, _Bound] = dict.fromkeys(
    """
    num_envs task.sim.physics_dt task.sim.decimation task.sim.solver_iterations task.sim.solver_ls_iterations
    task.terrain.num_levels task.terrain.patch_size task.terrain.cell_size
    task.control.action_scale task.control.action_clip task.control.hip_yaw_ratio
    task.control.posture_time_constant
    task.commands.resampling_time_s task.commands.curriculum.num_bins_lin_vel_x
    task.commands.curriculum.num_bins_ang_vel_z task.gait.frequency task.gait.contact_smoothing
    task.observations.history_length task.observations.clip
    task.rewards.tracking_kappa task.rewards.standing_kappa task.rewards.walking_kappa task.rewards.contact_vel_kappa
    task.rewards.contact_force_kappa task.rewards.foot_slip_kappa
    task.rewards.foot_swing_clip task.rewards.landing_height task.rewards.penalty_interval_steps
    task.terminations.episode_length_s task.terminations.max_roll task.terminations.max_pitch
    task.randomization.push_interval_s task.aids.interval_steps
    algo.num_steps_per_env algo.num_learning_epochs algo.num_mini_batches algo.clip_param algo.learning_rate
    algo.critic_learning_rate
    algo.desired_kl algo.max_grad_norm algo.network.embedding_dim algo.network.init_std
    plan.generalist_env_steps plan.max_rounds
    search.num_pairs search.num_steps search.num_directions search.std search.step
    correction.num_envs correction.num_steps correction.foresight_steps correction.damping
    evaluation.num_envs_per_robot evaluation.num_steps evaluation.physics_dt evaluation.decimation
    run.save_interval run.keep_checkpoints
    """.split(),
    _POSITIVE,
)
BOUNDS |= dict.fromkeys(
    """
    task.commands.standing_probability task.commands.upright_probability task.commands.curriculum.weight_step
    task.commands.curriculum.lin_vel_threshold task.commands.curriculum.ang_vel_threshold
    task.commands.curriculum.contact_force_threshold task.commands.curriculum.contact_vel_threshold
    task.gait.phase_offset task.gait.leg_scaling task.aids.harness_decay task.aids.gait_shaping_decay
    task.aids.min_episode_ratio task.aids.harness_return_ratio task.aids.min_contact_match
    task.aids.harness_contact_match task.control.upper_ratio task.control.waist_ratio
    algo.lam plan.tolerance plan.start_share search.standing_probability search.randomized_share
    correction.upright_share
    """.split(),
    _SHARE,
)
BOUNDS |= dict.fromkeys(
    """
    task.control.min_effort_ratio task.control.min_effort_ratio_leg_pitch task.control.min_effort_ratio_shoulder_pitch
    task.rewards.soft_limit_ratio
    task.rewards.penalty_initial task.rewards.penalty_exponent algo.mirror_fraction algo.gamma
    """.split(),
    _POSITIVE_SHARE,
)
BOUNDS["task.gait.stance_ratio"] = (
    "at least 0.35 and below 1: standing is phase 0.25, and is to be stance",
    lambda x: 0.35 <= x < 1,
)
BOUNDS["task.control.posture_reference"] = ("from 0 to 1.5", lambda x: 0 <= x <= 1.5)

CEILINGS: dict[str, float] = {
    "num_envs": 1e6,
    "evaluation.num_envs_per_robot": 1e6,
    "search.num_pairs": 1e6,
    "search.num_steps": 1e6,
    "search.num_directions": 1e5,
    "correction.num_envs": 1e5,
    "correction.num_steps": 1e6,
    "plan.judge_envs_per_robot": 1e6,
    "plan.specialist_num_envs": 1e6,
    "evaluation.num_steps": 1e6,
    "task.observations.history_length": 1e3,
    "task.observations.clock_harmonics": 1e2,
    "task.terrain.num_levels": 1e3,
    "task.commands.curriculum.num_bins_lin_vel_x": 1e3,
    "task.commands.curriculum.num_bins_ang_vel_z": 1e3,
    "algo.num_steps_per_env": 1e5,
    "algo.network.embedding_dim": 1e5,
    "run.num_threads": 1e4,
    "run.torch_threads": 1e4,
    "seed": 2**31 - 1,
    "evaluation.seed": 2**31 - 1,
}
"""Counts that are memory or threads: a slip of the finger is refused before it takes the machine down. Seeds."""

_MAX_ITEM = 1e5
"""Bound on any number in a list: widths, points, ranges."""
POSITIVE_ITEMS = {f"algo.network.{part}_dims" for part in ("encoder", "estimator", "actor", "critic")} | {
    "algo.network.std_range",
    "search.error_units",
    "algo.learning_rate_range",
    "task.observations.scales.command",
}
_OF_ROUNDS = ("teachers", "search_env_steps", "correction_env_steps", "max_rounds", "start_share")
"""Values of the plan for rounds of EAGLE or Kickstarting."""
_POSITIVE_RANGES = re.compile(r"task\.randomization\.(?:friction|(?!init_)\w+_scale)")


def leaves(cfg: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of a schema instance with its dotted path."""
    for f in dataclasses.fields(cfg):
        value = getattr(cfg, f.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{prefix}{f.name}.")
        else:
            yield prefix + f.name, value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _scalar_fault(path: str, value: float, default: float) -> str | None:
    if path.startswith(_WEIGHTS):
        sign = "0 or more, it is a reward" if default > 0 else "0 or less, it is a penalty"
        return None if value * (default or -1.0) >= 0 else f"got {value!r}, expected {sign}"
    if value > CEILINGS.get(path, math.inf):
        return f"got {value!r}, expected at most {CEILINGS[path]:g}"
    words, holds = BOUNDS.get(path, _NOT_NEGATIVE)
    return None if holds(value) else f"got {value!r}, expected {words}"


def _sequence_fault(path: str, value: tuple[Any, ...]) -> str | None:
    if any(isinstance(v, str) for v in value):
        return None
    if not value and path.endswith("_dims"):
        return "got [], expected at least one layer"
    if not all(abs(v) <= _MAX_ITEM for v in value):
        return f"got {list(value)}, expected finite numbers of at most {_MAX_ITEM:g}"
    if (path in POSITIVE_ITEMS or _POSITIVE_RANGES.match(path)) and min(value, default=1) <= 0:
        return f"got {list(value)}, expected numbers above 0"
    if len(value) == 2 and not path.endswith("_dims") and value[0] > value[1]:
        return f"got {list(value)}, expected the lower bound first"
    return None


def _single_faults(cfg: ExperimentCfg) -> Iterator[Fault]:
    defaults = dict(leaves(ExperimentCfg(name=cfg.name)))
    for path, value in leaves(cfg):
        fault: str | None = None
        if isinstance(value, tuple):
            fault = _sequence_fault(path, value)
        elif _is_number(value):
            finite = math.isfinite(value)
            fault = _scalar_fault(path, value, defaults[path]) if finite else f"got {value}, expected a finite number"
        if fault:
            yield path, fault


def _stepping_faults(path: str, cfg: SimCfg | EvaluationCfg) -> Iterator[Fault]:
    step = cfg.physics_dt * cfg.decimation
    if abs(step - CONTROL_STEP) > 1e-9:
        yield (
            f"{path}.decimation",
            f"physics_dt {cfg.physics_dt:g} x decimation {cfg.decimation} is {step:g} s, expected {CONTROL_STEP} s",
        )


def _curriculum_faults(path: str, cfg: CommandRangeCfg) -> Iterator[Fault]:
    if cfg.initial[0] < cfg.finishing[0] or cfg.initial[1] > cfg.finishing[1]:
        yield (
            path,
            f"initial {list(cfg.initial)} is not inside finishing {list(cfg.finishing)}; the curriculum only widens",
        )


def _scan_faults(path: str, scan: tuple[float, float, int]) -> Iterator[Fault]:
    if scan[2] < 1 or scan[0] > scan[1]:
        yield path, f"got {list(scan)}, expected first <= last and at least one point"


def _task_faults(cfg: ExperimentCfg) -> Iterator[Fault]:
    task = cfg.task
    yield from _stepping_faults("task.sim", task.sim)
    yield from _stepping_faults("evaluation", cfg.evaluation)
    if task.commands.curriculum.enabled:
        yield from _curriculum_faults("task.commands.lin_vel_x", task.commands.lin_vel_x)
        yield from _curriculum_faults("task.commands.ang_vel_z", task.commands.ang_vel_z)
    yield from _scan_faults("task.observations.scan_x", task.observations.scan_x)
    yield from _scan_faults("task.observations.scan_y", task.observations.scan_y)
    latency = task.randomization.sensing_latency_s
    if latency[0] < 0.0 or latency[1] > CONTROL_STEP:
        yield (
            "task.randomization.sensing_latency_s",
            f"got {list(latency)}, expected from 0 to {CONTROL_STEP} s, a control step",
        )
    if task.observations.descriptor == "extended" and not task.observations.embodiment_observation:
        yield "task.observations.descriptor", "extended needs embodiment_observation: true"
    if task.terrain.cell_size > task.terrain.patch_size:
        yield "task.terrain.cell_size", f"larger than patch_size {task.terrain.patch_size:g}"


def _learner_faults(cfg: ExperimentCfg) -> Iterator[Fault]:
    algo, plan = cfg.algo, cfg.plan
    pools = {"num_envs": cfg.num_envs}
    if plan.specialist_env_steps and plan.specialist_num_envs:
        pools["plan.specialist_num_envs"] = plan.specialist_num_envs
    for name, num_envs in pools.items():
        batch = num_envs * algo.num_steps_per_env
        if algo.num_mini_batches > 0 and batch % algo.num_mini_batches:
            yield (
                "algo.num_mini_batches",
                f"{algo.num_mini_batches} does not divide the batch of {name} {num_envs} x "
                f"num_steps_per_env {algo.num_steps_per_env} = {batch}",
            )
    low, high = algo.learning_rate_range
    if not low <= algo.learning_rate <= high:
        yield "algo.learning_rate", f"{algo.learning_rate:g} is outside learning_rate_range [{low:g}, {high:g}]"
    low, high = algo.network.std_range
    if not low <= algo.network.init_std <= high:
        yield "algo.network.init_std", f"{algo.network.init_std:g} is outside std_range [{low:g}, {high:g}]"


def _plan_faults(cfg: ExperimentCfg) -> Iterator[Fault]:
    if not cfg.robots:
        yield "robots", "expected at least one robot"
    stems = [Path(name).stem for name in cfg.robots]
    repeated = [name for name, stem in zip(cfg.robots, stems, strict=True) if stems.count(stem) > 1]
    if repeated:
        names = ", ".join(dict.fromkeys(repeated))
        yield "robots", f"named twice: {names}; expected files of different names, after which stages are named"
    if cfg.num_envs < len(cfg.robots):
        yield "num_envs", f"{cfg.num_envs} is less than one environment for each of {len(cfg.robots)} robots"
    plan = cfg.plan
    yield from _method_faults(cfg)
    own = "specialist" in plan.teachers or not plan.teachers or plan.max_rounds > 1
    if plan.method != "ppo":
        specialists = plan.specialist_env_steps + plan.search_env_steps + plan.correction_env_steps
        budgets = {"specialist_env_steps": specialists} if own else {}
        budgets["distill_env_steps"] = plan.distill_env_steps
        for key in (key for key, budget in budgets.items() if budget == 0):
            yield f"plan.{key}", f"0, but method {plan.method} needs a budget for this stage"
    for name, rollout in (("search", cfg.search), ("correction", cfg.correction)):
        steps, settling = rollout.num_steps, rollout.settling_steps
        if steps <= settling:
            yield f"{name}.num_steps", f"got {steps}, expected more than {name}.settling_steps, {settling}"
    for key in ("device", "env_device"):
        if not re.fullmatch(r"cpu|cuda(:\d+)?", getattr(cfg.run, key)):
            yield f"run.{key}", f"got {getattr(cfg.run, key)!r}, expected cpu, cuda or cuda:N"
    if not re.fullmatch(r"\w[\w.-]*", cfg.name):
        yield "name", f"got {cfg.name!r}, expected letters, digits, - and _: it names the run's folder"


def _method_faults(cfg: ExperimentCfg) -> Iterator[Fault]:
    """What is asked of rounds of specialists and distillation, where there is no such round."""
    plan, method = cfg.plan, cfg.plan.method
    if plan.teachers and len(plan.teachers) != len(cfg.robots):
        yield "plan.teachers", f"{len(plan.teachers)} named, expected one for each of {len(cfg.robots)} robots"
    if method in ("eagle", "kickstarting"):
        return
    unused = {f"plan.{key}": getattr(plan, key) for key in _OF_ROUNDS} | {"algo.use_ppo_loss": cfg.algo.use_ppo_loss}
    if method == "ppo" and plan.root is not None:
        del unused["plan.start_share"]
    defaults = dict(leaves(ExperimentCfg(name=cfg.name)))
    for path, value in unused.items():
        if value != defaults[path]:
            got = list(value) if isinstance(value, tuple) else value
            yield path, f"got {got}, but method {method} has no rounds; leave it out, or use eagle or kickstarting"


def _correction_faults(cfg: ExperimentCfg) -> Iterator[Fault]:
    correcting = cfg.correction
    if cfg.plan.correction_env_steps and not (correcting.std or correcting.foresight_std):
        yield "correction.std", "0, and so is correction.foresight_std: nothing is left to correct with"
    needed = correcting.settling_steps + correcting.foresight_steps
    if correcting.foresight_std and correcting.settling_steps < correcting.num_steps < needed:
        yield (
            "correction.num_steps",
            f"got {correcting.num_steps}, expected {needed} or more, to look ahead",
        )


def find_faults(cfg: ExperimentCfg) -> list[Fault]:
    """Everything wrong with a configuration whose types are right, in the order of the schema's groups."""
    checks = (_single_faults, _task_faults, _learner_faults, _plan_faults, _correction_faults)
    return [fault for check in checks for fault in check(cfg)]
