"""A sick environment is found in the step it falls ill, named, cut out and redrawn, and nobody else notices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.errors import ConfigError
from envs.humanoid_env import HumanoidEnv
from envs.sim.columns import consecutive
from envs.sim.fault import MAX_FILES, load_fault
from envs.sim.health import CAUSES, MAX_DISTANCE, MAX_HEIGHT, MAX_SPEED, FlightRecorder, diagnose, limits
from tests.envs.worlds import LOG_INTERVAL, actions, assert_same, make_env, robot

BAD = (float("nan"), float("inf"), -float("inf"), 1e12)
SICK, STEPS = 3, 5
OTHERS = torch.tensor([0, 1, 2, 4])


def spoil(env: HumanoidEnv, field: str, value: float) -> None:
    """Write a number into the physics of environment ``SICK``, the first of the second robot."""
    getattr(env.pool.batches[1], field)[0, 8] = value


def bad_action(step: int, value: float) -> torch.Tensor:
    action = actions(5, step)
    action[SICK, 3] = value
    return action


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("where", ["qpos", "qvel", "qacc_warmstart", "xfrc_applied", "action"])
def test_bad_numbers_are_caught_in_the_same_step_and_nobody_else_changes(where: str, value: float) -> None:
    healthy, spoiled = make_env(num_envs=5), make_env(num_envs=5)
    for step in range(STEPS):
        healthy.step(actions(5, step))
        spoiled.step(actions(5, step))
    batch = spoiled.pool.batches[1]
    if where == "xfrc_applied":
        for env in (healthy, spoiled):
            env.aids.harness[:] = 0.0  # which would overwrite it
            env._apply_aids()
        batch._batch.bind(where)[0, 1, 2] = value
    elif where == "qacc_warmstart":
        if value == 1e12:
            return  # a poor first guess is no fault
        batch._batch.bind(where)[0, 8] = value
    elif where != "action":
        spoil(spoiled, where, value)
    first = healthy.step(actions(5, STEPS))
    second = spoiled.step(bad_action(STEPS, value) if where == "action" else actions(5, STEPS))
    causes = [CAUSES[c - 1] if c else None for c in spoiled.pool.causes.tolist()]
    assert causes[SICK] in ({"action"} if where == "action" else {"non_finite", "velocity"})
    assert causes.count(None) == 4
    observations, rewards, dones, extras = second
    assert dones.tolist() == [i == SICK for i in range(5)]
    assert rewards[SICK] == 0.0
    assert not extras["time_outs"].any(), "nothing is expected of its future"
    assert spoiled.episode_count.tolist() == [1 + (i == SICK) for i in range(5)], "redrawn at once"
    assert all(torch.isfinite(x).all() for x in observations.values())
    for step in range(STEPS, STEPS + 15):
        assert_same(first[0], second[0], f"{value} in {where} of another environment", OTHERS)
        assert torch.equal(first[1][OTHERS], second[1][OTHERS]), "rewards"
        assert torch.equal(first[2][OTHERS], second[2][OTHERS]), "dones"
        assert all(torch.isfinite(x).all() for x in second[0].values())
        first, second = healthy.step(actions(5, step)), spoiled.step(actions(5, step))
        assert not spoiled.pool.causes.any(), "redrawn, it is healthy again"


def test_absurd_actions_in_absent_slots_harm_nobody() -> None:
    first, second = make_env(), make_env()
    absent = first.robots.slot_mask == 0
    for step in range(3):
        command = actions(4, step)
        out = first.step(command)
        assert_same(out[0], second.step(command.masked_fill(absent, torch.nan))[0], "an absent slot was read")
        assert not second.pool.causes.any()


def test_a_clock_that_stands_still_is_noticed() -> None:
    env = make_env()
    env.step(actions(4, 0))
    env.pool.batches[0]._time[1] = -5.0
    _, rewards, dones, _ = env.step(actions(4, 1))
    assert env.pool.causes.tolist() == [0, CAUSES.index("time") + 1, 0, 0]
    assert dones.tolist() == [False, True, False, False]
    assert rewards[1] == 0.0


def test_solver_warnings_count() -> None:
    env = make_env()
    env.pool.batches[1]._batch.warning[0, 1, 1] = 1
    _, _, dones, _ = env.step(actions(4, 0))
    assert env.pool.causes.tolist() == [0, 0, CAUSES.index("solver") + 1, 0]
    assert dones[2]
    env.step(actions(4, 1))
    assert not env.pool.causes.any(), "the warning ends with the episode"


@given(
    qpos=st.lists(st.floats(width=64), min_size=3, max_size=3),
    qvel=st.floats(width=64),
    moving=st.integers(0, 7),
    advanced=st.booleans(),
    warned=st.booleans(),
    wild=st.booleans(),
)
def test_diagnosis_names_the_first_cause(
    qpos: list[float], qvel: float, moving: int, advanced: bool, warned: bool, wild: bool
) -> None:
    columns = consecutive({"status": 1, "warning": 2, "sensordata": 1, "time": 1, "qpos": 9, "qvel": 8, "ctrl": 2})
    width = columns["ctrl"].stop
    row = torch.zeros(1, width, dtype=torch.float64)
    row[:, columns["qpos"].start : columns["qpos"].start + 3] = torch.tensor(qpos, dtype=row.dtype)
    row[:, columns["qvel"].start + moving], row[:, columns["warning"]] = qvel, float(warned)
    row[:, columns["sensordata"]] = row[:, columns["ctrl"]] = 1e9  # which are nobody's concern
    judged_by = (torch.from_numpy(x)[None] for x in limits(columns, width, np.finfo(np.float64).max))
    code = int(diagnose(row, *judged_by, torch.tensor([advanced]), torch.tensor([wild]))[0])
    if wild:
        expected = "action"
    elif not np.isfinite([*qpos, qvel]).all():
        expected = "non_finite"
    elif abs(qvel) > MAX_SPEED:
        expected = "velocity"
    elif abs(qpos[2]) > MAX_HEIGHT:
        expected = "height"
    elif max(abs(qpos[0]), abs(qpos[1])) > MAX_DISTANCE:
        expected = "distance"
    else:
        expected = "time" if not advanced else "solver" if warned else None
    assert (CAUSES[code - 1] if code else None) == expected


def test_sickness_is_counted_by_robot_and_cause() -> None:
    env = make_env(num_envs=5)
    for step in range(LOG_INTERVAL):
        if step in (4, 9):
            spoil(env, "qpos", np.nan)
        log = env.step(bad_action(step, np.inf) if step == 12 else actions(5, step))[3]["log"]
    counts = {tag: float(value) for tag, value in log.items() if tag.startswith("Health/") and "share" not in tag}
    assert len(counts) == 2 * len(CAUSES)
    assert {tag: n for tag, n in counts.items() if n} == {"Health/non_finite/g1": 2.0, "Health/action/g1": 1.0}
    assert float(log["Health/sick_share/g1"]) == pytest.approx(3 / (2 * LOG_INTERVAL))
    assert float(log["Health/sick_share/h1"]) == 0.0
    assert all(np.isfinite(float(value)) for value in log.values()), "one sick environment spoils the averages"


def test_the_last_states_are_kept(tmp_path: Path) -> None:
    env = make_env(num_envs=5)
    env.fault_folder = tmp_path / "faults"
    seen = []
    for step in range(12):
        if step == 11:
            spoil(env, "qvel", np.nan)
        env.step(actions(5, step))
        seen.append(env.pool.batches[1].qpos[0].copy())
    (path,) = env.fault_folder.iterdir()
    fault = load_fault(path)
    assert (fault.robot, fault.cause, fault.env) == ("g1", "non_finite", 0)
    assert np.array_equal(fault.qpos[:-1], np.float32(seen[4:11])), "the seven states before"
    assert np.isnan(fault.qpos[-1]).any(), "the sick state comes last"
    assert np.allclose(np.diff(fault.time), env.step_dt)
    assert fault.ctrl.shape == (FlightRecorder.LENGTH, robot("g1").num_joints)
    assert fault.qvel.shape == (FlightRecorder.LENGTH, env.pool.batches[1].model.nv)


def test_what_an_earlier_episode_did_is_not_mixed_in(tmp_path: Path) -> None:
    env = make_env(num_envs=5)
    env.fault_folder = tmp_path
    for step in range(12):
        if step in (8, 11):
            spoil(env, "qpos", np.nan)
        env.step(actions(5, step))
    lengths = [len(load_fault(path).time) for path in sorted(tmp_path.iterdir())]
    assert lengths == [8, 4], "as many as are kept, and three steps after where the second episode began"


def test_fault_files_are_few(tmp_path: Path) -> None:
    env = make_env(num_envs=5)
    env.fault_folder = tmp_path
    for step in range(MAX_FILES + 3):
        spoil(env, "qpos", np.nan)
        env.step(actions(5, step))
    assert len(list(tmp_path.iterdir())) == MAX_FILES


def test_a_folder_that_cannot_be_written_does_not_stop_the_environment(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    env = make_env(num_envs=5)
    env.fault_folder = tmp_path / "file" / "faults"
    spoil(env, "qpos", np.nan)
    assert env.step(actions(5, 0))[2][SICK]


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 torn", b"no archive at all"])
def test_other_files_are_refused_in_words(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"x\.npz: not a fault file"):
        load_fault(path)


def test_pickled_objects_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    np.savez(path, robot=np.array([object()], dtype=object))
    with pytest.raises(ConfigError, match="not a fault file"):
        load_fault(path)
    np.savez(path, robot="g1", robot_file="", cause="time", env=0, time=[0.0], qpos=[0.0], qvel=[[0.0]], ctrl=[[0.0]])
    with pytest.raises(ConfigError, match="one row per control step"):
        load_fault(path)
