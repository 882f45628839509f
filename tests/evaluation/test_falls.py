"""How robots fall, told from scripted falls and from real ones."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
import torch

from eagle_rl.cli.environment import make_env_factory
from eagle_rl.config.schema import AidsCfg, EvaluationCfg, RunCfg, TaskCfg
from eagle_rl.evaluation.evaluate import evaluate
from eagle_rl.evaluation.falls import LOOK_BACK_S, Fall, FallWatch, falls_table
from eagle_rl.evaluation.metrics import RobotMetrics
from eagle_rl.evaluation.protocol import step_dt
from eagle_rl.evaluation.report import falls_of
from envs.humanoid_env import HumanoidEnv
from envs.robots.slots import SLOT_INDEX
from tests.envs.worlds import make_env
from tests.evaluation.fake import ScriptedEnv, idle
from tests.evaluation.test_report import result

DT = 0.02
BACK = round(LOOK_BACK_S / DT)
FALL = Fall(time_s=1.0, command=(0.0, 0.0, 0.0, -0.25, 0.1), direction="backward", at_stops=("left_ankle_pitch",))


def watch_a_fall(gravity: tuple[float, float, float], steps: int, at_stop_from: int) -> Fall:
    """The first of two robots falls in the last of so many steps; its joint 4 is at its stop from some step on."""
    env = ScriptedEnv(2, TaskCfg())
    watch, fell = FallWatch(env, DT), torch.tensor([True, False])
    command = torch.tensor([[0.1, 0.2, 0.3, -0.2, 0.4], [0.0] * 5])
    for step in range(steps):
        env.at_stop = torch.zeros(2, 32, dtype=torch.bool)
        env.at_stop[0, 4] = step >= at_stop_from
        env.at_stop[1, 9] = True
        if step == steps - 1:
            env.gravity = torch.tensor([gravity, (0.0, 0.0, -1.0)])
        watch.look()
        watch.note(step, command, fell & (step == steps - 1))
    (fall,) = watch.falls
    return fall


@pytest.mark.parametrize(
    ("gravity", "direction"),
    [
        ((0.6, 0.1, -0.8), "forward"),
        ((-0.6, 0.1, -0.8), "backward"),
        ((0.1, 0.6, -0.8), "left"),
        ((-0.1, -0.6, -0.8), "right"),
    ],
)
def test_a_fall_goes_where_the_base_leaned_most_just_before(gravity, direction):
    assert watch_a_fall(gravity, steps=3, at_stop_from=99).direction == direction


def test_a_fall_says_when_it_was_and_under_which_command():
    fall = watch_a_fall((0.6, 0.0, -0.8), steps=50, at_stop_from=99)
    assert fall.time_s == pytest.approx(1.0)
    assert fall.command == pytest.approx((0.1, 0.2, 0.3, -0.2, 0.4))


def test_joints_are_looked_at_before_the_fall_throws_them_about():
    steps = 3 * BACK
    assert watch_a_fall((0.6, 0.0, -0.8), steps, at_stop_from=steps - BACK).at_stops == ("joint_4",)
    assert watch_a_fall((0.6, 0.0, -0.8), steps, at_stop_from=steps - BACK + 1).at_stops == ()


def test_after_less_than_that_joints_are_those_of_the_start():
    assert watch_a_fall((0.6, 0.0, -0.8), steps=3, at_stop_from=0).at_stops == ("joint_4",)
    assert watch_a_fall((0.6, 0.0, -0.8), steps=3, at_stop_from=1).at_stops == ()


def test_a_joint_is_at_its_stop_from_its_soft_limit_on_and_absent_slots_never_are():
    env: HumanoidEnv = make_env()
    lower, upper = env.robots.joint_soft_lower, env.robots.joint_soft_upper
    knee, present = SLOT_INDEX["left_knee_pitch"], env.robots.slot_mask > 0
    for joint_pos, ends in (((lower + upper) / 2, False), (upper.clone(), True), (lower - 0.01, True)):
        env._state = dataclasses.replace(env.state, joint_pos=joint_pos)
        _, at_stop = env.balance()
        assert at_stop[:, knee].all() == ends, f"{at_stop[:, knee]} at {joint_pos[:, knee]}"
        assert not at_stop[~present].any()


def test_the_direction_of_a_real_fall_is_that_of_the_base():
    """By the gravity that the simulation measures of robots turned about each axis, 0.6 rad either way."""
    env, ids, c, s = make_env(), torch.arange(4), math.cos(0.3), math.sin(0.3)
    root = torch.zeros(4, 13)
    root[:, 2] = 2.0
    root[:, 3:7] = torch.tensor([[c, 0.0, s, 0.0], [c, 0.0, -s, 0.0], [c, s, 0.0, 0.0], [c, -s, 0.0, 0.0]])
    env.pool.place(ids, root, env.robots.default_joint_pos, torch.zeros(4, 32))
    env.pool.restage(ids, env.pool.staging_rows(ids))
    env._state = None
    watch = FallWatch(env, DT)
    watch.look()
    watch.note(0, torch.zeros(4, 5), torch.ones(4, dtype=torch.bool))
    assert [fall.direction for fall in watch.falls] == ["forward", "backward", "right", "left"]


def test_every_environment_that_did_not_survive_has_one_fall_whatever_the_chunks():
    ev, task = EvaluationCfg(num_envs_per_robot=140, num_steps=120), TaskCfg(aids=AidsCfg(harness=0.0))
    make = make_env_factory(RunCfg(num_threads=1))
    whole, parts = (evaluate(idle, make, ["h1"], task, ev, chunk_envs=chunk)["h1"] for chunk in (256, 128))
    assert len(whole.falls) == round((1 - whole.survival) * 140) > 0
    assert whole == parts
    times = [fall.time_s for fall in whole.falls]
    assert times == sorted(times)
    assert 0 < times[0] <= times[-1] <= 120 * step_dt(task)


def test_falls_are_read_back_as_they_were_written_and_older_results_have_none():
    metrics = dataclasses.replace(result((0.1,) * 5).robots["h1"], falls=(FALL,))
    data = json.loads(json.dumps(dataclasses.asdict(metrics)))
    assert RobotMetrics.from_dict(data) == metrics
    del data["falls"]
    assert RobotMetrics.from_dict(data).falls == ()


def test_the_table_tells_what_falls_have_in_common():
    others = [dataclasses.replace(FALL, time_s=2.0 + i, direction="left", at_stops=()) for i in range(2)]
    later = dataclasses.replace(FALL, time_s=9.0, command=(0.5, 0.0, 0.0, 0.0, 0.0))
    text = falls_table({("n1", "PPO"): ([FALL, *others, later], 256), ("h1", "PPO"): ([], 256)})
    row = "| n1 | PPO | 4 of 256 | 2.5 | backward 50%, left 50% | +0.00, +0.00, +0.00, -0.25, +0.10 | "
    assert row + "left_ankle_pitch 50% |" in text
    assert "h1" not in text


def test_joints_that_are_seldom_at_their_stops_are_not_told():
    falls = [FALL] + [dataclasses.replace(FALL, at_stops=()) for _ in range(10)]
    assert "left_ankle_pitch" not in falls_table({("n1", "PPO"): (falls, 256)})


def test_nobody_fell_is_no_table():
    assert falls_table({("n1", "PPO"): ([], 256)}) == ""


def test_falls_of_a_method_are_those_of_all_its_seeds():
    one = result((0.1,) * 5)
    metrics = dataclasses.replace(one.robots["h1"], falls=(FALL,))
    fallen = dataclasses.replace(one, robots={"h1": metrics})
    falls, count = falls_of({"PPO": [fallen, fallen]})["h1", "PPO"]
    assert falls == [FALL, FALL]
    assert count == 2 * metrics.num_envs
