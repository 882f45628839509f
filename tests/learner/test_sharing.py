"""Shares and kernels: an update computes what one thread would by the code as it is written."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, fx

from eagle_rl import kernels
from eagle_rl.algorithms import sharing
from eagle_rl.algorithms.sharing import MIN_WORK
from eagle_rl.algorithms.specialists import SpecialistBank
from eagle_rl.errors import EagleWarning
from eagle_rl.runners.on_policy import EagleRunner
from eagle_rl.threads import use_threads
from tests.learner.helpers import NETWORK, collect, make_runner, parameters
from tests.toy import ToyEnv

ENVS = 25
"""Makes 200 rows, which three threads cannot share out evenly; no other width is like it."""
ONE_STEP = {"num_learning_epochs": 1, "num_mini_batches": 1, "max_grad_norm": 1e9}


@pytest.fixture
def worth_sharing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small networks would need thousands of rows."""
    monkeypatch.setattr(sharing, "MIN_WORK", 1)


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> list[fx.GraphModule]:
    """Replays what was recorded operation by operation, and tells what it was."""
    made: list[fx.GraphModule] = []

    def as_it_is(graph: fx.GraphModule, inputs: list[Tensor]) -> fx.GraphModule:
        made.append(graph)
        return graph

    monkeypatch.setattr(kernels, "compile_graph", as_it_is)
    return made


def gradient(runner: EagleRunner) -> dict[str, Tensor]:
    """What an update leaves in the parameters that learn."""
    runner.alg.update()
    models = {"actor": runner.alg.actor, "critic": runner.alg.critic}
    named = {f"{m}.{name}": p.grad for m, model in models.items() for name, p in model.named_parameters()}
    return {name: grad.clone() for name, grad in named.items() if grad is not None}


def require_alike(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    assert found.keys() == expected.keys(), "other parameters got a gradient"
    for name, value in expected.items():
        bound = tolerance * value.abs().max().item()
        torch.testing.assert_close(found[name], value, rtol=0, atol=bound, msg=lambda m, n=name: f"{n}: {m}")


def imitating(runner: EagleRunner, method: str | None) -> EagleRunner:
    if method is not None:
        runner.alg.imitate(SpecialistBank([copy.deepcopy(runner.alg.actor) for _ in range(3)]), method)
    return runner


ALGOS: dict[str, tuple[dict[str, Any], str | None]] = {
    "ppo": ({}, None),
    "bfloat16": ({"precision": "bfloat16"}, None),
    "two-sided": ({"network": replace(NETWORK, symmetric=True)}, None),
    "distillation": ({}, "eagle"),
    "imitation": ({"use_ppo_loss": False}, "eagle"),
    "kickstarting": ({}, "kickstart"),
    "clipped value": ({"use_clipped_value_loss": True}, None),
}


@pytest.mark.usefixtures("worth_sharing")
@pytest.mark.parametrize(("algo", "method"), ALGOS.values(), ids=ALGOS)
@pytest.mark.parametrize("threads", [2, 3])
def test_the_gradient_of_an_update_with_several_threads_is_that_with_one(algo, method, threads, monkeypatch):
    counts, gradients = [], []
    share_out = sharing.share_out
    monkeypatch.setattr(sharing, "share_out", lambda do, tasks: counts.append(len(tasks)) or share_out(do, tasks))
    for count in (1, threads):
        use_threads(1)
        runner = imitating(make_runner(env=ToyEnv(ENVS), **ONE_STEP, **algo), method)
        collect(runner)
        use_threads(count)
        gradients.append(gradient(runner))
    assert counts[-1] == threads, "nothing was shared out, so the test shows nothing"
    require_alike(gradients[1], gradients[0], 0.03 if "precision" in algo else 1e-4)


@pytest.mark.usefixtures("worth_sharing")
def test_what_is_told_of_an_update_does_not_depend_on_the_number_of_threads():
    told = []
    for threads in (1, 3):
        use_threads(1)
        runner = imitating(make_runner(env=ToyEnv(ENVS), **ONE_STEP), "eagle")
        collect(runner)
        runner.alg.storage.observations["robot"][:] = 0  # nothing is told of robots that have no rows
        use_threads(threads)
        told.append(runner.alg.update())
    assert told[0].keys() == told[1].keys()
    assert {tag for tag in told[0] if "L_a/" in tag} == {f"Distill/L_a/{runner.alg.robot_names[0]}"}
    for tag, value in told[0].items():
        assert told[1][tag] == pytest.approx(value, rel=1e-3, abs=1e-6), tag


def test_a_share_is_worth_the_hand_over():
    gradient = make_runner().alg.gradient
    size = sum(p.numel() for model in (make_runner().alg.actor, make_runner().alg.critic) for p in model.parameters())
    use_threads(4)
    few = MIN_WORK // size
    assert [gradient.num_shares(rows) for rows in (1, few, 2 * few, 3 * few + 3, 100 * few)] == [1, 1, 1, 3, 4]
    use_threads(1)
    assert gradient.num_shares(100 * few) == 1


@pytest.mark.usefixtures("worth_sharing")
@pytest.mark.parametrize(("threads", "precision", "shares"), [(5, "float32", 5), (2, "float32", 1), (5, "bfloat16", 1)])
def test_actions_are_shared_out_in_float32_where_rows_come_out_even(threads, precision, shares, monkeypatch):
    runner = make_runner(env=ToyEnv(ENVS), precision=precision)
    obs, decisions, counts = runner.env.get_observations(), [], []

    def counting(do, tasks):
        counts.append(len(tasks))
        return share_out(do, tasks)

    share_out = sharing.share_out
    monkeypatch.setattr(sharing, "share_out", counting)
    for count in (1, threads):
        use_threads(count)
        torch.manual_seed(0)
        decisions.append(runner.alg.acting(obs))
    assert counts == [1, shares]
    for name, expected in vars(decisions[0]).items():
        torch.testing.assert_close(getattr(decisions[1], name), expected, msg=f"{name} depends on who works it out")


@pytest.mark.usefixtures("worth_sharing")
def test_a_repetition_has_the_same_bits_whichever_thread_was_faster():
    use_threads(3)
    ends = []
    for _ in range(3):
        runner = make_runner(env=ToyEnv(ENVS))
        runner.learn(3)
        ends.append(parameters(runner))
    assert all(torch.equal(end[name], x) for end in ends[1:] for name, x in ends[0].items()), "depends on timing"


@pytest.mark.usefixtures("worth_sharing")
@pytest.mark.parametrize("compile_from", [100, 1])
def test_a_resumed_run_with_two_threads_equals_the_uninterrupted_one_bit_for_bit(tmp_path, compile_from, monkeypatch):
    def not_quite(graph: fx.GraphModule, *_: object, **__: object) -> Any:
        """What a kernel of other rounding might return, so that it matters which steps are taken by kernels."""
        return lambda *inputs: [1.001 * x for x in graph(*inputs)]

    monkeypatch.setattr(kernels, "compile_graph", not_quite)
    use_threads(2)

    def runner() -> EagleRunner:
        made = make_runner(tmp_path, ToyEnv(ENVS))
        made.alg.compile_from = compile_from
        return made

    whole = runner()
    whole.learn(4)
    saved = runner().learn(2)
    resumed = runner()
    resumed.load(saved)
    resumed.learn(2)
    expected, found = parameters(whole), parameters(resumed)
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == [], "learned otherwise"


@pytest.mark.usefixtures("worth_sharing")
@pytest.mark.parametrize(("algo", "method"), ALGOS.values(), ids=ALGOS)
def test_kernels_do_what_the_code_does_at_every_value_of_the_parameters(algo, method, graphs):
    """Two iterations: parameters that had become constants of a kernel would show in the second."""
    ends = []
    for compile_from in (100, 0):
        use_threads(2)
        runner = imitating(make_runner(env=ToyEnv(ENVS), **algo), method)
        runner.alg.compile_from = compile_from
        runner.learn(2)
        ends.append(parameters(runner))
    assert len(graphs) == 3, "one for acting, one for values, one for shares, which are of one size"
    require_alike(ends[1], ends[0], 0.02 if "precision" in algo else 1e-4)


@pytest.mark.usefixtures("worth_sharing")
def test_neither_rows_nor_parameters_are_constants_of_the_kernels(graphs):
    runner = imitating(make_runner(env=ToyEnv(ENVS)), "eagle")
    runner.alg.compile_from = 0
    runner.learn(1)
    learned = {tuple(p.shape) for p in (*runner.alg.actor.parameters(), *runner.alg.critic.parameters())}
    for graph in graphs:
        constants = [getattr(graph, node.target) for node in graph.graph.nodes if node.op == "get_attr"]
        floats = {tuple(x.shape) for x in constants if x.is_floating_point()} - {()}
        signs = {(len(sign),) for _, sign in runner.env.mirror.values()}
        assert floats <= signs, f"beyond the mirror's signs: {floats - signs}; parameters are {learned}"


def test_kernels_are_used_from_the_update_on_that_was_said(graphs):
    runner = make_runner()
    runner.alg.compile_from = 2
    made = []
    runner.learn(4, on_iteration=lambda _: made.append(len(graphs)))
    assert made == [0, 0, 3, 3], "after two updates robots act and are valued and the policy learns by kernels"


def test_without_a_compiler_a_run_goes_on_and_says_so_once(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    runner = make_runner()
    runner.alg.compile_from = 1
    with pytest.warns(EagleWarning, match=r"no C\+\+ compiler.*goes on without") as warned:
        runner.learn(3)
    assert len(warned) == 3, "one of learning, one of acting, one of valuing"
    plain = make_runner()
    plain.learn(3)
    for name, x in parameters(plain).items():
        assert torch.equal(parameters(runner)[name], x), name


def test_compiled_kernels_act_and_learn_as_the_code_does_up_to_rounding():
    ends = []
    for compile_from in (100, 0):
        runner = make_runner(estimation_coef=0.0, mirror_coef=0.0)  # less to compile
        runner.alg.compile_from = compile_from
        runner.learn(2)
        ends.append(parameters(runner))
    require_alike(ends[1], ends[0], 1e-3)
