"""Whether a stage takes its environments' steps, acts and learns by compiled kernels."""

from __future__ import annotations

from typing import Any

from eagle_rl.algorithms.eagle_ppo import EaglePPO
from eagle_rl.config.schema import RunCfg

WORTH_IT = 5_000_000
"""Environment steps from which on compiling saves more time than it takes [-] (docs/performance.md)."""
FROM_STEP = 1000
"""Control step at which kernels are compiled: a run that is only tried out ends before."""


def compile_where_it_pays(env: Any, alg: EaglePPO, run: RunCfg, env_steps: int) -> None:
    """Compile the steps of an environment, by ``env.compile()``, and of a learner as ``run.compile`` says.

    No clock has a say in it, so that a resumed run computes what the interrupted one would have. A learner on a GPU
    does without.

    Args:
        env: the environments of a stage.
        alg: its learner.
        run: whether and where.
        env_steps: budget of the stage.

    Raises:
        CompileError: it must be compiled and cannot be.
    """
    learns_on_cpu = run.device == "cpu"
    if run.compile == "always":
        env.compile()
        alg.compile_from = 0 if learns_on_cpu else alg.compile_from
    elif run.compile == "auto" and env_steps >= WORTH_IT:
        if run.env_device == "cpu":
            env.compile(from_step=FROM_STEP)
        if learns_on_cpu:
            alg.compile_from = FROM_STEP // alg.cfg.num_steps_per_env
