"""When a stage compiles its environments' steps."""

from __future__ import annotations

import pytest

from eagle_rl.config.schema import RunCfg
from eagle_rl.errors import CompileError, EagleWarning
from eagle_rl.runners.compiling import WORTH_IT, compile_where_it_pays


class Environment:
    """Counts how often it is compiled; cannot be, if told so."""

    def __init__(self, fails: bool = False) -> None:
        self.compiled = 0
        self._fails = fails

    def compile(self) -> None:
        if self._fails:
            raise CompileError("There is no C++ compiler.")
        self.compiled += 1


@pytest.mark.parametrize(
    ("run", "env_steps", "compiled"),
    [
        (RunCfg(), WORTH_IT, True),
        (RunCfg(), WORTH_IT - 1, False),
        (RunCfg(env_device="cuda"), WORTH_IT, False),
        (RunCfg(compile="never"), WORTH_IT, False),
        (RunCfg(compile="always"), 1, True),
    ],
)
def test_steps_are_compiled_where_it_pays_or_is_asked_for(run: RunCfg, env_steps: int, compiled: bool) -> None:
    env = Environment()
    compile_where_it_pays(env, run, env_steps, "generalist")
    assert env.compiled == compiled


def test_without_a_compiler_a_run_goes_on_unless_it_must_compile() -> None:
    with pytest.warns(EagleWarning, match=r"no C\+\+ compiler.*goes on without"):
        compile_where_it_pays(Environment(fails=True), RunCfg(), WORTH_IT, "generalist")
    with pytest.raises(CompileError):
        compile_where_it_pays(Environment(fails=True), RunCfg(compile="always"), 1, "generalist")
