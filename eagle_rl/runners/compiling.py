"""Whether a stage takes its environments' steps by compiled kernels."""

from __future__ import annotations

from typing import Any

from eagle_rl.config.schema import RunCfg

WORTH_IT = 5_000_000
"""Environment steps from which on compiling saves more time than it takes [-] (docs/performance.md)."""
FROM_STEP = 1000
"""Control step at which kernels are compiled: a run that is only tried out ends before."""


def compile_where_it_pays(env: Any, run: RunCfg, env_steps: int) -> None:
    """Compile an environment's steps as ``run.compile`` says, by ``env.compile()``.

    No clock has a say in it, so that a resumed run computes what the interrupted one would have.

    Args:
        env: the environments of a stage.
        run: whether and where.
        env_steps: budget of the stage.

    Raises:
        CompileError: it must be compiled and cannot be.
    """
    if run.compile == "always":
        env.compile()
    elif run.compile == "auto" and env_steps >= WORTH_IT and run.env_device == "cpu":
        env.compile(from_step=FROM_STEP)
