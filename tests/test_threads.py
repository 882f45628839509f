"""Work shared out among threads: who does it, and what is left of it when one of them fails."""

from __future__ import annotations

import os
import threading
import time

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from eagle_rl.models.precision import set_up_torch
from eagle_rl.threads import num_threads, share_out, use_threads
from tests.forked import exit_code_in_fork


@settings(max_examples=40, deadline=None)
@given(threads=st.integers(1, 5), tasks=st.lists(st.integers(), max_size=12))
def test_results_come_in_the_order_of_the_tasks(threads, tasks):
    use_threads(threads)
    assert share_out(lambda x: (x, x + 1), tasks) == [(x, x + 1) for x in tasks]


@pytest.mark.parametrize("count", [1, 2, 5])
def test_every_task_is_done_once_in_at_most_so_many_threads(count):
    done, where = [], set()

    def do(task: int) -> None:
        done.append(task)
        where.add(threading.get_ident())

    use_threads(count)
    for _ in range(50):
        share_out(do, range(7))
    assert sorted(done) == sorted([*range(7)] * 50)
    assert len(where) <= count


def test_results_come_in_the_order_of_the_tasks_whichever_is_done_first():
    second_is_done = threading.Event()

    def first_last(task: int) -> int:
        if task == 0:
            assert second_is_done.wait(30)
        elif task == 1:
            second_is_done.set()
        return task

    use_threads(2)
    assert share_out(first_last, [0, 1, 2]) == [0, 1, 2]


def test_a_helper_does_one_of_two_tasks_and_the_caller_the_other():
    met = threading.Barrier(2, timeout=30)  # neither goes on before the other has begun

    def meet(_: int) -> threading.Thread:
        met.wait()
        return threading.current_thread()

    use_threads(2)
    threads = share_out(meet, [0, 1])
    assert len(set(threads)) == 2
    assert threading.current_thread() in threads


def test_the_caller_does_not_wait_for_a_thread_that_is_busy():
    use_threads(2)
    release, begun = threading.Event(), threading.Event()

    def keep_the_helper_busy() -> None:
        def hold(task: int) -> None:
            if threading.current_thread() is blocked:
                assert begun.wait(30)
            else:
                begun.set()
                assert release.wait(30)

        blocked = threading.current_thread()
        share_out(hold, [0, 1])

    other = threading.Thread(target=keep_the_helper_busy)
    other.start()
    assert begun.wait(30)
    me = threading.current_thread()
    assert share_out(lambda _: threading.current_thread(), [0, 1, 2]) == [me] * 3
    release.set()
    other.join()


def test_what_goes_wrong_in_a_helper_reaches_the_caller_when_all_are_over_and_the_next_call_is_sound():
    caller, begun, done = threading.current_thread(), threading.Event(), []

    def fail_in_a_helper(task: int) -> int:
        if threading.current_thread() is caller:
            assert begun.wait(30), "no helper began"
            time.sleep(0.02)
            done.append(task)
            return task
        begun.set()
        raise ArithmeticError("of a helper")

    use_threads(2)
    with pytest.raises(ArithmeticError, match="of a helper"):
        share_out(fail_in_a_helper, [0, 1])
    assert len(done) == 1, "the caller's own task was broken off"
    assert share_out(lambda x: x, [0, 1, 2]) == [0, 1, 2]


def work_in_child() -> None:
    os._exit(0 if share_out(lambda x: x * x, [1, 2, 3]) == [1, 4, 9] else 3)


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork")
def test_a_forked_process_makes_threads_of_its_own():
    use_threads(2)
    share_out(abs, [1, 2])
    assert exit_code_in_fork(work_in_child) == 0, "the child computes something else than its parent"


def test_fewer_threads_are_let_go():
    before = threading.active_count()
    use_threads(3)
    share_out(abs, [1, 2, 3])
    assert threading.active_count() > before
    use_threads(1)
    assert threading.active_count() == before


def test_torch_itself_computes_with_one_thread_however_many_learn():
    set_up_torch(3)
    assert torch.get_num_threads() == 1
    assert num_threads() == 3
    met = threading.Barrier(3, timeout=30)

    def count(_: int) -> int:
        met.wait()
        return torch.get_num_threads()

    assert share_out(count, [0, 1, 2]) == [1, 1, 1]
