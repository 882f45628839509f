"""Survival and errors while one thing about the world gets worse and everything else stays nominal."""

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


SWEEPS: Mapping[str, Sweep] = {
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
    "mass": Sweep(
        label="mass and inertia of every link, factor [-]",
        values=(0.6, 0.8, 1.0, 1.2, 1.4),
        apply=lambda v: replace(NOMINAL, link_mass_scale=(v, v)),
    ),
}
"""Latency ends at one control step, the longest the environment models."""


def sweep(
    policy: Policy, make_env: MakeEnv, robots: Sequence[str], task: TaskCfg, ev: EvaluationCfg, kind: str
) -> dict[float, dict[str, RobotMetrics]]:
    """Scores of each robot at each strength of one of SWEEPS, under the same commands throughout."""
    ev = replace(ev, randomization=True)
    return {
        value: evaluate(policy, make_env, robots, replace(task, randomization=SWEEPS[kind].apply(value)), ev)
        for value in SWEEPS[kind].values
    }
