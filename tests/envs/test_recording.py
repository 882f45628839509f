"""Recorded and compiled methods do what the methods do, and compiled environments what the others do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor, fx

from eagle_rl import kernels
from eagle_rl.config.schema import AidsCfg, CommandsCfg, ControlCfg, ObservationsCfg, TaskCfg, TerrainCfg
from eagle_rl.errors import CompileError, EagleWarning
from envs.humanoid_env import HumanoidEnv
from envs.recording import InBlocks, Recording
from tests.envs.worlds import actions, assert_same, make_env

N = 13
"""Environments: no other width of the pool's tensors, so that a constant of this size is one of an environment."""
PARTS = ("_aim", "_judge", "_derive_groups", "_look", "_begin")


@dataclass(kw_only=True)
class Pair:
    left: Tensor
    right: Tensor


class Sums(NamedTuple):
    total: Tensor
    scaled: Tensor | None


class Tally:
    """A method with all that may be recorded: a dataclass, None, a view, scratch, another method."""

    def __init__(self) -> None:
        self.pair = Pair(left=torch.arange(6.0).view(2, 3), right=torch.ones(2, 3))
        self.inner = type("Inner", (), {"scale": None})()
        self.count = torch.zeros(2, dtype=torch.int64)
        self.mean: Tensor | None = None

    def add(self, x: Tensor) -> Sums:
        self.count = self.count + 1
        self.pair = Pair(left=self.pair.left + x, right=self.pair.left[:, :3])
        self.mean = self.pair.left.mean(dim=1)
        (total,) = self.total()
        return Sums(total, None if self.inner.scale is None else total * self.inner.scale)

    def total(self) -> tuple[Tensor]:
        total = self.pair.left.sum(dim=1)
        total.mul_(2.0)
        return (total,)


def record(tally: Tally) -> Recording:
    reads = ("pair", "count", "inner.scale")
    return Recording(tally, tally.add, reads, ("pair", "count"), ("mean",))


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replays what was recorded operation by operation."""

    def as_it_is(graph: fx.GraphModule, inputs: list[Tensor]) -> fx.GraphModule:
        return graph

    monkeypatch.setattr(kernels, "compile_graph", as_it_is)


@pytest.mark.usefixtures("uncompiled")
def test_a_recording_returns_and_writes_what_its_method_does() -> None:
    plain, tally = Tally(), Tally()
    add = record(tally)
    for step in range(4):
        if step == 2:
            plain.inner.scale = tally.inner.scale = torch.tensor(3.0)
        plain.mean = tally.mean = None
        x = torch.full((2, 3), float(step))
        expected, result = plain.add(x), add(x.double() if step == 3 else x)
        assert torch.equal(result.total, expected.total), "in what precision an argument comes must not matter"
        assert (result.scaled is None) == (expected.scaled is None) == (step < 2)
        assert result.scaled is None or torch.equal(result.scaled, expected.scaled)
        assert torch.equal(tally.pair.left, plain.pair.left)
        assert torch.equal(tally.pair.right, plain.pair.right)
        assert tally.count.tolist() == [step + 1] * 2
        assert tally.mean is None, "what a method works out for itself is not written"
    assert len(add.graphs) == 2, "one kernel for each set of attributes that are not None"


class Passing:
    """A method that renames one attribute and does not use another."""

    def __init__(self) -> None:
        self.new, self.old, self.idle = torch.arange(3.0), torch.zeros(3), torch.ones(3)

    def turn(self) -> tuple[Tensor]:
        self.old, self.new = self.new, self.new + 1.0
        return (self.old * 2.0,)


@pytest.mark.usefixtures("uncompiled")
def test_what_passes_through_is_not_copied_and_what_is_not_used_is_not_asked_for() -> None:
    passing = Passing()
    turn = Recording(passing, passing.turn, ("new", "old", "idle"), ("new", "old"))
    for step in range(3):
        before = passing.new
        (doubled,) = turn()
        assert passing.old is before
        assert doubled.tolist() == [2.0 * (i + step) for i in range(3)]
        assert passing.new.tolist() == [i + step + 1.0 for i in range(3)]
    (graph,) = turn.graphs
    assert sum(node.op == "placeholder" for node in graph.graph.nodes) == 1
    assert len(graph(passing.new)) == 2, "the new value and what is returned"


@pytest.mark.usefixtures("uncompiled")
def test_recording_leaves_the_owner_as_it_was_and_results_share_no_memory() -> None:
    tally = Tally()
    before = tally.pair
    add = record(tally)
    add.make(torch.ones(2, 3))
    assert tally.pair is before
    assert tally.count.tolist() == [0, 0]
    add(torch.ones(2, 3))
    tally.pair.right.zero_()
    assert tally.pair.left.any(), "a view was handed out"
    assert before.left.tolist() == torch.arange(6.0).view(2, 3).tolist()


class Lottery:
    """A method of any number of rows, one of whose results is left out."""

    def __init__(self) -> None:
        self.prizes = torch.arange(10.0)
        self.calls = 0

    def draw(self, ids: Tensor) -> Sums:
        self.calls += 1
        return Sums(self.prizes[ids] * 2.0, None)


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 7, 16, 17])
def test_a_recording_in_blocks_returns_as_many_rows_as_are_asked_for(count: int) -> None:
    lottery, ids = Lottery(), torch.arange(17).flip(0)[:count] % 10
    recording = Recording(lottery, lottery.draw, ("prizes",))
    recording.make(torch.zeros(2, dtype=torch.long))
    draw, recorded = InBlocks(recording, lottery.draw, 2), lottery.calls
    drawn = draw(ids)
    assert drawn.total.tolist() == [2.0 * i for i in ids.tolist()]
    assert drawn.scaled is None
    left = not 0 < count <= 2 * InBlocks.MOST
    assert lottery.calls - recorded == left, "more rows than so many blocks are left to the method, fewer are not"


@pytest.mark.usefixtures("uncompiled")
def test_methods_that_a_recorded_method_calls_are_recorded_with_it() -> None:
    tally = Tally()
    total = Recording(tally, tally.total, ("pair",))
    total.make()
    tally.total = total  # type: ignore[method-assign]
    assert record(tally)(torch.ones(2, 3)).total.tolist() == [12.0, 30.0]
    assert record(tally)(torch.ones(2, 3)).total.tolist() == [18.0, 36.0]


def test_without_a_compiler_the_message_says_how_to_get_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    env = make_env(num_envs=2)
    with pytest.raises(CompileError, match=r"'no-such-compiler'.*apt install"):
        env.compile()
    assert not any(part in vars(env) for part in PARTS), "the environment is half compiled"
    env.step(actions(2, 0))


def test_a_failing_compiler_is_reported_and_does_not_end_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch._inductor as inductor

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("ld: no space left")

    monkeypatch.setattr(inductor, "compile", fail)
    add = record(Tally())
    with pytest.raises(CompileError, match="no space left"):
        add.make(torch.ones(2, 3))
    plain, tally = Tally(), Tally()
    add = record(tally)
    with pytest.warns(EagleWarning, match="no space left"):
        first = add(torch.ones(2, 3))
    tally.mean = None
    assert torch.equal(first.total, plain.add(torch.ones(2, 3)).total)
    assert torch.equal(add(torch.ones(2, 3)).total, plain.add(torch.ones(2, 3)).total), "it warns once"


def outcomes(env: HumanoidEnv, steps: int) -> Iterator[dict[str, Tensor]]:
    """All that a user sees of some steps, falls, time-outs and new commands among them."""
    env.episode_length_buf = env.max_episode_length - 2 - 3 * torch.arange(N)
    for step in range(steps):
        observations, rewards, dones, extras = env.step(3.0 * actions(N, step))
        errors = {"errors": env.tracking_errors(), "contact": env.state.foot_contact.float()}
        log = {tag: torch.as_tensor(value) for tag, value in extras["log"].items()}
        final = {f"final {name}": x for name, x in extras["final_observations"].items()}
        step_ = {"rewards": rewards, "dones": dones, "time_outs": extras["time_outs"]}
        yield dict(observations.items()) | final | step_ | errors | log


TASKS = {
    "default": TaskCfg(),
    "paper": replace(
        TaskCfg(), control=ControlCfg(posture_reference=0.0), observations=ObservationsCfg(clock_harmonics=2)
    ),
    "no embodiment, no harness": replace(
        TaskCfg(), observations=ObservationsCfg(embodiment_observation=False), aids=AidsCfg(harness=0.0)
    ),
    "uneven ground": replace(TaskCfg(), terrain=TerrainCfg(kind="rough")),
    "quick commands": replace(TaskCfg(), commands=CommandsCfg(resampling_time_s=0.1)),
}


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_recorded_environment_does_what_the_plain_one_does_to_the_bit(task: TaskCfg) -> None:
    plain, recorded = make_env(num_envs=N, task=task), make_env(num_envs=N, task=task)
    recorded.compile()
    falls = 0
    for expected, result in zip(outcomes(plain, 30), outcomes(recorded, 30), strict=True):
        assert expected.keys() == result.keys()
        for name, value in expected.items():
            assert torch.equal(value, result[name]), name
        falls += int(expected["dones"].sum())
    assert falls > 3, "nothing ended, so that resets were not compared"


@pytest.mark.usefixtures("uncompiled")
def test_nothing_that_belongs_to_an_environment_is_a_constant_of_the_kernels() -> None:
    env = make_env(num_envs=N)
    env.compile()
    for part in PARTS:
        for graph in getattr(env, part).graphs:
            constants = [getattr(graph, node.target) for node in graph.graph.nodes if node.op == "get_attr"]
            shapes = [tuple(x.shape) for x in constants]
            assert all(N not in shape for shape in shapes), f"{part} reads a tensor that _PARTS does not name: {shapes}"


@pytest.mark.usefixtures("uncompiled")
def test_a_recorded_environment_resumes_to_the_bit() -> None:
    env, other = make_env(num_envs=N), make_env(num_envs=N)
    for each in (env, other):
        each.compile()
    list(outcomes(env, 5))
    other.load_state_dict(env.state_dict())
    for step in range(10):
        expected, result = env.step(actions(N, step)), other.step(actions(N, step))
        assert_same(expected[0], result[0], f"step {step}")
        assert torch.equal(expected[1], result[1])


@pytest.mark.usefixtures("uncompiled")
def test_kernels_are_used_from_the_step_on_that_was_said() -> None:
    env = make_env(num_envs=N)
    env.compile(from_step=3)
    for step in range(5):
        assert [part for part in PARTS if part in vars(env)] == ([] if step < 4 else list(PARTS)), step
        env.step(actions(N, step))


def test_a_failure_in_the_middle_of_a_run_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    env = make_env(num_envs=2)
    env.compile(from_step=1)
    env.step(actions(2, 0))
    with pytest.warns(EagleWarning, match=r"no C\+\+ compiler.*goes on without"):
        env.step(actions(2, 1))
    env.step(actions(2, 2))


def test_compiled_kernels_equal_the_code_up_to_rounding() -> None:
    plain, compiled = make_env(num_envs=N), make_env(num_envs=N)
    compiled.compile()
    for step in range(8):
        expected, result = plain.step(actions(N, step)), compiled.step(actions(N, step))
        for name, value in expected[0].items():
            torch.testing.assert_close(result[0][name], value, rtol=0.0, atol=2e-5, msg=f"{name}, step {step}")
        torch.testing.assert_close(result[1], expected[1], rtol=0.0, atol=1e-5)
        assert torch.equal(result[2], expected[2])
