"""Survival and errors while one thing about the world, or the body, gets worse and everything else stays nominal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from eagle_rl.config.schema import EvaluationCfg, RandomizationCfg, TaskCfg
from eagle_rl.evaluation.evaluate import MakeEnv, Policy, evaluate
from eagle_rl.evaluation.metrics import RobotMetrics

NOMINAL = RandomizationCfg(
    friction=(1.0, 1.0),
    stiffness_scale=(1.0, 1.0),
    damping_scale=(1.0, 1.0),
    strength_scale=(1.0, 1.0),
    motor_offset=(0.0, 0.0),
    sensing_latency_s=(0.0, 0.0),
    link_mass_scale=(1.0, 1.0),
    link_com_offset=(0.0, 0.0),
    base_mass_ratio=(0.0, 0.0),
    base_com_offset=(0.0, 0.0),
    push_lin_vel=0.0,
    push_ang_vel=0.0,
    init_joint_scale=(1.0, 1.0),
    init_joint_vel=(0.0, 0.0),
    init_root_vel=(0.0, 0.0),
)
"""Randomization in which every draw is the nominal value."""


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """One disturbance and its strengths."""

    label: str
    values: tuple[float, ...]
    apply: Callable[[float], RandomizationCfg]


DISTURBANCES: Mapping[str, Sweep] = {
    "push": Sweep(
        label="push every 5 s, up to [m/s, rad/s]",
        values=(0.0, 0.3, 0.6, 0.9, 1.2),
        apply=lambda v: replace(NOMINAL, push_lin_vel=v, push_ang_vel=v),
    ),
    "friction": Sweep(
        label="friction coefficient [-]",
        values=(0.2, 0.4, 0.6, 0.8, 1.0, 1.5),
        apply=lambda v: replace(NOMINAL, friction=(v, v)),
    ),
    "payload": Sweep(
        label="payload on the base, share of the robot's mass [-]",
        values=(0.0, 0.1, 0.2, 0.3, 0.4),
        apply=lambda v: replace(NOMINAL, base_mass_ratio=(v, v)),
    ),
    "latency": Sweep(
        label="sensing latency [s]",
        values=(0.0, 0.005, 0.01, 0.015, 0.02),
        apply=lambda v: replace(NOMINAL, sensing_latency_s=(v, v)),
    ),
}
"""Latency ends at one control step, the longest the environment models."""


def _around(spread: float) -> tuple[float, float]:
    return 1.0 - spread, 1.0 + spread


BODIES: Mapping[str, Sweep] = {
    "size": Sweep(
        label="all lengths, factor [-]",
        values=(0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3),
        apply=lambda v: replace(NOMINAL, morphology_length_scale=(v, v)),
    ),
    "mass": Sweep(
        label="all masses, factor [-]",
        values=(0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6),
        apply=lambda v: replace(NOMINAL, morphology_mass_scale=(v, v)),
    ),
    "build": Sweep(
        label="size and mass of a body, within ± [-]",
        values=(0.0, 0.1, 0.2, 0.3, 0.4),
        apply=lambda v: replace(NOMINAL, morphology_length_scale=_around(v), morphology_mass_scale=_around(v)),
    ),
    "proportions": Sweep(
        label="mass of each link, within ± [-]",
        values=(0.0, 0.2, 0.4, 0.6, 0.8),
        apply=lambda v: replace(NOMINAL, link_mass_scale=_around(v)),
    ),
}
"""Bodies no robot of the fleet has: each grade leads further away from those trained on."""


def sweep(
    policy: Policy, make_env: MakeEnv, robots: Sequence[str], task: TaskCfg, ev: EvaluationCfg, through: Sweep
) -> dict[float, dict[str, RobotMetrics]]:
    """Scores of each robot at each strength, under the same commands throughout."""
    ev = replace(ev, randomization=True)
    return {
        value: evaluate(policy, make_env, robots, replace(task, randomization=through.apply(value)), ev)
        for value in through.values
    }
