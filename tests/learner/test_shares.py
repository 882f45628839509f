"""Rows shared out among threads: what a network computes is what it computed by itself."""

from __future__ import annotations

import copy
import multiprocessing
import os
import pickle
import threading

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rsl_rl.modules import MLP
from torch import Tensor, nn

from eagle_rl.models import shares
from eagle_rl.models.precision import keep_outputs_exact, set_up_torch
from eagle_rl.models.shares import MIN_WORK, SharedMLP, use_threads
from tests.learner.helpers import collect, make_runner, parameters
from tests.toy import ToyEnv

INPUTS, OUTPUTS = 7, 3
MIN_ROWS = 64
"""Of a share, in these tests: small networks would need thousands to be worth it."""
ENOUGH = 2 * MIN_ROWS + 1
"""Rows that two threads share, one of them with one more."""


REALLY_LEAST = shares._least_rows


@pytest.fixture(autouse=True, scope="module")
def small_shares():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shares, "_least_rows", lambda network: MIN_ROWS)
        yield


def plain(seed: int = 0) -> MLP:
    torch.manual_seed(seed)
    return MLP(INPUTS, OUTPUTS, (16, 8), "elu")


def shared(network: MLP) -> SharedMLP:
    return SharedMLP(copy.deepcopy(network))


def rows(count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(count, INPUTS, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def learned(network: nn.Module, x: Tensor, input_learns: bool = False) -> dict[str, Tensor]:
    """Outputs and all gradients of a loss that treats no two rows alike."""
    x = x.clone().requires_grad_(input_learns)
    output = network(x)
    weights = torch.linspace(-1.0, 2.0, output.numel(), dtype=output.dtype).view_as(output)
    (weights * output.square()).sum().backward()
    grads = {name: p.grad for name, p in network.named_parameters()} | {"input": x.grad}
    return {"output": output.detach()} | {name: grad for name, grad in grads.items() if grad is not None}


def require_alike(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    assert found.keys() == expected.keys(), "other parameters got a gradient than without threads"
    for name, value in expected.items():
        assert found[name].dtype == value.dtype, f"{name}: {found[name].dtype}, without threads {value.dtype}"
        scale = value.abs().max().item()
        torch.testing.assert_close(
            found[name],
            value,
            rtol=0,
            atol=tolerance * scale,
            msg=lambda m, n=name: f"{n} is not what it is without threads: {m}",
        )


def blocks_of(network: MLP, x: Tensor) -> list[int]:
    """Rows of each block that the network computes, largest first."""
    sizes: list[int] = []
    handle = network[0].register_forward_hook(lambda _, inputs, __: sizes.append(len(inputs[0])))
    network(x)
    handle.remove()
    return sorted(sizes, reverse=True)


def test_a_share_is_worth_the_hand_over(monkeypatch):
    monkeypatch.setattr(shares, "_least_rows", REALLY_LEAST)
    small, large = SharedMLP(plain()), SharedMLP(MLP(512, 32, (256, 128), "elu"))
    assert small._least_rows * sum(p.numel() for p in small.parameters()) == pytest.approx(MIN_WORK, rel=1e-3)
    use_threads(2)
    few, many = torch.zeros(384, 512), torch.zeros(1536, 512)
    assert blocks_of(large, few) == [384], "two thirds of a millisecond were lost to save one"
    assert blocks_of(large, many) == [768, 768]


@settings(max_examples=40)
@given(
    threads=st.integers(1, 5),
    count=st.integers(1, 6 * MIN_ROWS),
    input_learns=st.booleans(),
    seed=st.integers(0, 99),
)
def test_outputs_and_gradients_are_those_without_threads(threads, count, input_learns, seed):
    network, x = plain(seed).double(), rows(count, seed, torch.float64)
    twin = shared(network)
    use_threads(threads)
    require_alike(learned(twin, x, input_learns), learned(network, x, input_learns), 1e-12)


@pytest.mark.parametrize(
    ("threads", "count", "sizes"),
    [
        (1, 9 * MIN_ROWS, [9 * MIN_ROWS]),
        (2, 2 * MIN_ROWS - 1, [2 * MIN_ROWS - 1]),
        (2, ENOUGH, [MIN_ROWS + 1, MIN_ROWS]),
        (4, ENOUGH, [MIN_ROWS + 1, MIN_ROWS]),
        (4, 4 * MIN_ROWS + 2, [MIN_ROWS + 1, MIN_ROWS + 1, MIN_ROWS, MIN_ROWS]),
        (4, 0, [0]),
    ],
)
def test_rows_are_shared_evenly_among_as_many_threads_as_get_enough_of_them(threads, count, sizes):
    use_threads(threads)
    assert blocks_of(shared(plain()), rows(count)) == sizes


def test_a_helper_computes_one_of_two_shares_and_the_caller_the_other():
    network, threads = shared(plain()), []
    met = threading.Barrier(2, timeout=30)  # neither goes on before the other has begun

    def meet(*_: object) -> None:
        met.wait()
        threads.append(threading.current_thread())

    network[0].register_forward_hook(meet)
    use_threads(2)
    network(rows(ENOUGH))
    assert len(set(threads)) == 2
    assert threading.current_thread() in threads


def test_a_repetition_has_the_same_bits_whichever_thread_was_faster():
    network, x = shared(plain()), rows(5 * MIN_ROWS)
    use_threads(3)
    first = learned(network, x, True)
    for _ in range(20):
        network.zero_grad()
        again = learned(network, x, True)
        assert all(torch.equal(again[name], value) for name, value in first.items()), "a result depends on timing"


def test_hidden_layers_are_bfloat16_under_autocast_in_every_thread_and_outputs_stay_float32():
    network, dtypes = plain(), []
    keep_outputs_exact(nn.ModuleList([network]))
    twin, x = shared(network), rows(4 * MIN_ROWS)
    for layer in (network[0], twin[0]):
        layer.register_forward_hook(lambda _, __, output: dtypes.append(output.dtype))
    use_threads(4)
    with torch.autocast("cpu", torch.bfloat16):
        expected, found = learned(network, x, True), learned(twin, x, True)
        assert torch.is_autocast_enabled("cpu")
    assert dtypes == [torch.bfloat16] * 5
    assert found["output"].dtype == torch.float32
    require_alike(found, expected, 0.01)  # bfloat16 keeps three digits


def test_without_gradients_there_is_no_graph():
    network, x = shared(plain()), rows(ENOUGH)
    use_threads(2)
    with torch.no_grad():
        assert not network(x).requires_grad
    with torch.inference_mode():
        output = network(x)
    assert output.is_inference()
    torch.testing.assert_close(output, network(x).detach())


@pytest.mark.parametrize("input_learns", [False, True])
@pytest.mark.parametrize("frozen", ["0.weight", "2.bias", ""])
def test_what_is_frozen_gets_no_gradient(frozen, input_learns):
    """The empty name freezes all of the network, as imitation does with the critic."""
    network = plain()
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(frozen not in name)
    twin, x = shared(network), rows(ENOUGH)
    use_threads(2)
    if frozen or input_learns:
        require_alike(learned(twin, x, input_learns), learned(network, x, input_learns), 1e-5)
    else:
        assert not twin(x).requires_grad


@pytest.mark.parametrize("when", ["forward", "backward"])
def test_what_goes_wrong_in_a_helper_reaches_the_caller_and_the_next_call_is_sound(when):
    network, x = shared(plain()), rows(ENOUGH)
    caller, begun = threading.current_thread(), threading.Event()

    def fail_in_a_helper(*_: object) -> None:
        if threading.current_thread() is caller:
            assert begun.wait(30), "no helper began"
            return
        begun.set()
        raise ArithmeticError("of a helper")

    def hook(_: nn.Module, __: object, output: Tensor) -> None:
        if when == "forward":
            fail_in_a_helper()
        else:
            output.register_hook(fail_in_a_helper)

    use_threads(2)
    handle = network[2].register_forward_hook(hook)
    with pytest.raises(ArithmeticError, match="of a helper"):
        learned(network, x)
    handle.remove()
    network.zero_grad()
    found = learned(network, x)
    use_threads(1)
    network.zero_grad()
    require_alike(found, learned(network, x), 1e-5)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda network: pickle.loads(pickle.dumps(network))])
def test_a_copy_and_the_weights_by_name_are_those_of_a_plain_network(duplicate):
    network, x = plain(), rows(ENOUGH)
    twin = shared(network)
    use_threads(2)
    expected = twin(x)
    assert torch.equal(duplicate(twin)(x), expected)
    assert list(twin.state_dict()) == list(network.state_dict())
    assert [name for name, _ in twin.named_parameters()] == [name for name, _ in network.named_parameters()]
    other = shared(plain(1))
    other.load_state_dict(network.state_dict())
    assert torch.equal(other(x), expected)


def test_an_export_is_whole_and_holds_for_any_number_of_rows():
    network = shared(plain())
    use_threads(2)
    batch = torch.export.Dim("batch")
    program = torch.export.export(network, (rows(ENOUGH),), dynamic_shapes={"x": {0: batch}})
    for count in (2, 5 * MIN_ROWS):
        torch.testing.assert_close(program.module()(rows(count)), network(rows(count)))


def learn_in_child(network: SharedMLP, x: Tensor, expected: dict[str, Tensor]) -> None:
    network.zero_grad()
    found = learned(network, x, True)
    os._exit(0 if all(torch.equal(found[name], value) for name, value in expected.items()) else 3)


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork")
def test_a_forked_process_makes_threads_of_its_own():
    network, x = shared(plain()), rows(ENOUGH)
    use_threads(2)
    expected = learned(network, x, True)
    child = multiprocessing.get_context("fork").Process(target=learn_in_child, args=(network, x, expected))
    child.start()
    child.join(60)
    hangs = child.is_alive()
    if hangs:
        child.kill()
        child.join()
    assert not hangs, "the child waits for threads of its parent"
    assert child.exitcode == 0, "the child computes something else than its parent"


def test_fewer_threads_are_let_go():
    before = threading.active_count()
    use_threads(3)
    shared(plain())(rows(3 * MIN_ROWS))
    assert threading.active_count() > before
    use_threads(1)
    assert threading.active_count() == before


def test_torch_itself_computes_with_one_thread_however_many_learn():
    set_up_torch(3)
    assert torch.get_num_threads() == 1
    assert blocks_of(shared(plain()), rows(3 * MIN_ROWS)) == [MIN_ROWS] * 3


@pytest.mark.parametrize("algo", [{}, {"precision": "bfloat16"}, {"use_ppo_loss": False}], ids=str)
def test_the_gradient_of_an_update_with_two_threads_is_that_with_one(algo, monkeypatch):
    shared_out, gradients = [], []
    apply = shares._Shares.apply
    monkeypatch.setattr(shares._Shares, "apply", lambda *args: shared_out.append(args[1]) or apply(*args))
    for threads in (1, 2):
        use_threads(1)
        env = ToyEnv(MIN_ROWS)  # makes eight times as many rows
        runner = make_runner(env=env, num_learning_epochs=1, num_mini_batches=1, max_grad_norm=1e9, **algo)
        collect(runner)
        use_threads(threads)
        runner.alg.update()
        models = {"actor": runner.alg.actor, "critic": runner.alg.critic}
        named = {f"{m}.{name}": p.grad for m, model in models.items() for name, p in model.named_parameters()}
        gradients.append({name: grad.clone() for name, grad in named.items() if grad is not None})
    assert set(shared_out) == {2}, "nothing was shared out, so the test shows nothing"
    require_alike(gradients[1], gradients[0], 0.03 if "precision" in algo else 1e-4)


def test_a_resumed_run_with_two_threads_equals_the_uninterrupted_one_bit_for_bit(tmp_path):
    use_threads(2)
    whole = make_runner(env=ToyEnv(2 * MIN_ROWS))
    whole.learn(4)
    saved = make_runner(tmp_path, ToyEnv(2 * MIN_ROWS)).learn(2)
    resumed = make_runner(tmp_path, ToyEnv(2 * MIN_ROWS))
    resumed.load(saved)
    resumed.learn(2)
    expected, found = parameters(whole), parameters(resumed)
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == [], "learned otherwise"
