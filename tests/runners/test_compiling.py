"""When a stage compiles its environments' steps and what it learns by."""

from __future__ import annotations

import math
from types import SimpleNamespace

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
    ("run", "env_steps", "compiled", "from_update"),
    [
        (RunCfg(), WORTH_IT, [FROM_STEP], FROM_STEP // 24),
        (RunCfg(), WORTH_IT - 1, [], math.inf),
        (RunCfg(env_device="cuda"), WORTH_IT, [], FROM_STEP // 24),
        (RunCfg(device="cuda"), WORTH_IT, [FROM_STEP], math.inf),
        (RunCfg(compile="never"), WORTH_IT, [], math.inf),
        (RunCfg(compile="always"), 1, [None], 0),
        (RunCfg(compile="always", device="cuda"), 1, [None], math.inf),
    ],
)
def test_steps_and_gradients_are_compiled_where_it_pays_or_is_asked_for(
    run: RunCfg, env_steps: int, compiled: list[int | None], from_update: float
) -> None:
    env, alg = Environment(), SimpleNamespace(compile_from=math.inf, cfg=SimpleNamespace(num_steps_per_env=24))
    compile_where_it_pays(env, alg, run, env_steps)
    assert env.compiled == compiled
    assert alg.compile_from == from_update
