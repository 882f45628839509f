"""Whether a stage takes its environments' steps by compiled kernels."""

from __future__ import annotations

import warnings
from typing import Any

from rich.console import Console

from eagle_rl.config.schema import RunCfg
from eagle_rl.errors import CompileError, EagleWarning

WORTH_IT = 2_000_000
"""Environment steps from which on compiling saves more time than it takes [-] (docs/performance.md)."""


def compile_where_it_pays(env: Any, run: RunCfg, env_steps: int, name: str) -> None:
    """Compile an environment's steps as ``run.compile`` says, by ``env.compile()``.

    Nothing that a clock says decides, so that a resumed run computes what the interrupted one would have.

    Args:
        env: the environments of a stage.
        run: whether and where.
        env_steps: budget of the stage.
        name: of the stage.

    Raises:
        CompileError: it must be compiled and cannot be.
    """
    wanted = run.compile == "always"
    pays = run.compile == "auto" and env_steps >= WORTH_IT and run.env_device == "cpu"
    if not (wanted or pays):
        return
    Console(stderr=True).print(
        f"{name}: compiling the environment's step; the first time on a machine it takes half a minute",
        highlight=False,
        soft_wrap=True,
    )
    try:
        env.compile()
    except CompileError as error:
        if wanted:
            raise
        warnings.warn(f"{error} Training goes on without, a little slower.", EagleWarning, stacklevel=2)
