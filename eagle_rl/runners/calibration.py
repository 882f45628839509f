"""What a specialist should ask of itself for what is asked of it.

Learners come to rest short of some commands: T1 made half of every sideways velocity, along a straight line, where
PPO's reward is flat and the tracking error is not (docs/experiments.md, 19). Asked for more, it does more. So
a specialist tries a few gains on its velocity commands and keeps the best of them in its own weights.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from statistics import fmean

from eagle_rl.config.schema import EvaluationCfg, TaskCfg
from eagle_rl.evaluation.evaluate import MakeEnv, evaluate
from eagle_rl.evaluation.report import pooled_score
from eagle_rl.models import EagleActor

VELOCITIES = {"v_y": 1, "v_x": 0, "omega": 2}
"""Commands that may be amplified, by component; v_y first, of which most is left."""
GAINS = (1.1, 1.2)
"""Tried on each [-]; a policy has seen no commands beyond its range, so they stay close to it."""
MIN_IMPROVEMENT = 0.005
"""Share of the tracking score a gain must be worth [-]."""
MAX_LOSS = 0.05
"""Share by which all gains together may make any command's error larger [-]: N1, walking faster, swings more."""
NUM_STEPS = 300
"""Control steps of a trial, at most."""


def calibrate(
    actor: EagleActor, make_env: MakeEnv, robots: Sequence[str], task: TaskCfg, ev: EvaluationCfg, device: str
) -> dict[str, float]:
    """Amplify an actor's velocity commands, in its weights, where its robots then follow them better.

    Args:
        actor: the policy; its weights change.
        make_env: builds the environments.
        robots: robots to judge it on.
        task: the task it was trained in.
        ev: the protocol; commands are drawn with a seed of their own, so that those of the judge stay unseen.
        device: where the environments are.

    Returns:
        The gain of each velocity [-], then the tracking score before and after.
    """
    ev = dataclasses.replace(ev, num_steps=min(ev.num_steps, NUM_STEPS), seed=ev.seed + 1)

    def measure(gains: Sequence[float]) -> tuple[float, list[float]]:
        """Tracking score and charged error of each command, mean over robots."""
        trial = EagleActor.from_architecture(actor.architecture)
        trial.load_state_dict(actor.state_dict())
        trial.scale_command(gains)
        metrics = evaluate(trial.to(device), make_env, robots, task, ev)
        charged = [robot.subsets["all"].charged for robot in metrics.values()]
        return pooled_score(metrics), [fmean(error or 0.0 for error in errors) for errors in zip(*charged, strict=True)]

    best = [1.0] * actor.architecture["observations"]["command"]
    before, errors = measure(best)
    after = before
    for component in VELOCITIES.values():
        for gain in GAINS:
            gains = [gain if i == component else kept for i, kept in enumerate(best)]
            score, now = measure(gains)
            harms = any(error > first * (1 + MAX_LOSS) for error, first in zip(now, errors, strict=True))
            if harms or score > after * (1 - MIN_IMPROVEMENT):
                break
            best, after = gains, score
    actor.scale_command(best)
    return {name: best[i] for name, i in VELOCITIES.items()} | {"score_before": before, "score_after": after}
