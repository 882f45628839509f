"""When a stage compiles its environments' steps."""

from __future__ import annotations

import pytest

from eagle_rl.config.schema import RunCfg
from eagle_rl.runners.compiling import FROM_STEP, WORTH_IT, compile_where_it_pays


class Environment:
    """Remembers from which step on it was to use kernels."""

    def __init__(self) -> None:
        self.compiled: list[int | None] = []

    def compile(self, from_step: int | None = None) -> None:
        self.compiled.append(from_step)


@pytest.mark.parametrize(
    ("run", "env_steps", "compiled"),
    [
        (RunCfg(), WORTH_IT, [FROM_STEP]),
        (RunCfg(), WORTH_IT - 1, []),
        (RunCfg(env_device="cuda"), WORTH_IT, []),
        (RunCfg(compile="never"), WORTH_IT, []),
        (RunCfg(compile="always"), 1, [None]),
    ],
)
def test_steps_are_compiled_where_it_pays_or_is_asked_for(
    run: RunCfg, env_steps: int, compiled: list[int | None]
) -> None:
    env = Environment()
    compile_where_it_pays(env, run, env_steps)
    assert env.compiled == compiled
