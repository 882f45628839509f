from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

from eagle_rl.errors import HealthError
from eagle_rl.runners import checkpoint as ckpt
from eagle_rl.runners.health import SICK_WINDOW, SickRule
from tests.learner.helpers import make_runner
from tests.toy import ToyEnv


def scalars(share: float, robot: str = "g1") -> dict[str, float]:
    return {f"Health/sick_share/{robot}": share, f"Health/velocity/{robot}": 3.0, f"Health/action/{robot}": 0.0}


def iterations_until_stop(rule: SickRule, share: float, robot: str = "g1") -> int | None:
    for iteration in range(1, 4 * SICK_WINDOW):
        try:
            rule.check(scalars(share, robot))
        except HealthError:
            return iteration
    return None


def test_a_rate_above_the_limit_stops_the_run() -> None:
    rule = SickRule({"h1": 100_000, "g1": 100_000}, None)
    assert iterations_until_stop(rule, 0.0009) is None
    assert iterations_until_stop(SickRule({"g1": 100_000}, None), 0.002) == 6, "the window starts healthy"
    assert iterations_until_stop(SickRule({"g1": 100_000}, None), 0.5) == 1


def test_sickness_long_ago_is_forgotten() -> None:
    rule = SickRule({"g1": 100_000}, None)
    for _ in range(5):
        rule.check(scalars(0.0019))
        for _ in range(SICK_WINDOW):
            rule.check({})


def test_one_robot_is_enough_and_is_named(tmp_path: Path) -> None:
    rule = SickRule({"h1": 100_000, "g1": 100_000}, tmp_path / "faults")
    with pytest.raises(HealthError) as stop:
        rule.check({"Health/sick_share/h1": 0.0} | scalars(0.02))
    message = str(stop.value)
    for word in ("g1: 0.20%", "0.10%", "velocity 3", str(tmp_path / "faults"), "--replay-fault", "physics_dt"):
        assert word in message
    assert "action 0" not in message


def test_single_cases_in_a_small_pool_do_not_stop_it() -> None:
    assert iterations_until_stop(SickRule({"g1": 48}, None), 1 / 48) == SICK_WINDOW


class SickToy(ToyEnv):
    """A toy whose second robot is always ill."""

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        *rest, extras = super().step(actions)
        extras["log"] |= {"Health/sick_share/two": 0.5, "Health/solver/two": 4.0}
        return (*rest, extras)


def test_a_stopped_run_leaves_a_checkpoint_and_names_the_folder_of_faults(tmp_path: Path) -> None:
    runner = make_runner(tmp_path, SickToy())
    assert runner.env.fault_folder == tmp_path / "faults"
    with pytest.raises(HealthError, match=r"two: 5\.00% .*solver 4"):
        runner.learn(5)
    assert ckpt.load_checkpoint(tmp_path / "checkpoints" / "model_1").manifest["iteration"] == 1
