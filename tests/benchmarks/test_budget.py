from __future__ import annotations

import time

import pytest

from benchmarks.budget import Budget
from benchmarks.measure import in_turns


class Work:
    """Methods that take a known time on a clock of our own."""

    now = 0.0

    def outer(self) -> str:
        self.spend(1.0)
        self.inner()
        self.spend(2.0)
        return "result"

    def inner(self) -> None:
        self.spend(10.0)

    def fail(self) -> None:
        self.spend(3.0)
        raise ValueError("as asked")

    def spend(self, seconds: float) -> None:
        Work.now += seconds


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr(Work, "now", 0.0)
    for name in ("perf_counter", "process_time"):
        monkeypatch.setattr(time, name, lambda: Work.now)


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize(("whole", "expected"), [(False, {"a": 3.0, "b": 10.0}), (True, {"a": 13.0})])
def test_a_section_has_its_own_time_or_all_of_its_callees(whole, expected):
    budget, work = Budget(), Work()
    budget.watch(Work, "outer", "a", whole=whole)
    budget.watch(Work, "inner", "b")
    with budget:
        work.spend(5.0)
        assert work.outer() == "result"
    assert budget.wall == budget.cpu == expected | {"other": 5.0}


@pytest.mark.usefixtures("clock")
def test_time_until_an_error_is_booked_and_what_follows_is_not():
    budget, work = Budget(), Work()
    budget.watch(work, "fail", "a", whole=True)
    with budget:
        with pytest.raises(ValueError, match="as asked"):
            work.fail()
        work.inner()
    assert budget.wall == {"a": 3.0, "other": 10.0}


def test_watched_methods_are_put_back():
    before, work, budget = vars(Work).copy(), Work(), Budget()
    budget.watch(Work, "outer", "a")
    budget.watch(work, "inner", "b")
    with budget:
        assert "inner" in vars(work)
    assert vars(Work).copy() == before | {"now": Work.now}
    assert not vars(work)


@pytest.mark.usefixtures("clock")
def test_costs_are_medians_over_the_rounds_that_count():
    calls = {"quick": 0, "slow": 0}

    def act(name: str, seconds: float) -> None:
        calls[name] += 1
        Work.now += 100.0 if calls[name] <= 3 else seconds  # a slow start, which is not counted

    costs = in_turns({"quick": lambda: act("quick", 1.0), "slow": lambda: act("slow", 4.0)}, seconds=0.0)
    assert calls == {"quick": 8, "slow": 8}
    assert (costs["quick"].wall, costs["slow"].wall) == (1.0, 4.0)
