"""What a step promises: shapes, isolation, true last observations, no side effects."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.config.schema import (
    AidsCfg,
    CommandsCfg,
    ControlCfg,
    ObservationsCfg,
    RandomizationCfg,
    RewardsCfg,
    TaskCfg,
    TerminationsCfg,
)
from eagle_rl.errors import ConfigError
from envs.humanoid_env import HumanoidEnv
from envs.mdp.observations import proprioception
from envs.mdp.rewards import reward_factors
from tests.envs.worlds import BARE, LOG_INTERVAL, actions, assert_same, make_env, rollout

FALLEN = (0.7071067811865476, 0.7071067811865476, 0.0, 0.0)
SHORT = replace(TaskCfg(), terminations=TerminationsCfg(episode_length_s=0.2))


def topple(env: HumanoidEnv, row: int) -> None:
    """Lay one environment's robot on its side, so that the next step ends its episode."""
    index, local, _ = env.pool.split(torch.tensor([row]))[0]
    env.pool.batches[index].qpos[local, 3:7] = FALLEN


def others(env: HumanoidEnv, row: int) -> Tensor:
    return torch.tensor([i for i in range(env.num_envs) if i != row])


@pytest.mark.parametrize(("embodiment", "harmonics"), [(True, 0), (False, 0), (True, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_observations_have_the_announced_shapes(embodiment: bool, harmonics: int, dtype: torch.dtype) -> None:
    observed = ObservationsCfg(embodiment_observation=embodiment, clock_harmonics=harmonics)
    task = replace(TaskCfg(), observations=observed)
    env = make_env(num_envs=5, task=task, dtype=dtype)
    assert env.robots.robot_id.tolist() == [0, 0, 0, 1, 1]
    observations, rewards, dones, extras = env.step(actions(5, 0))
    for group in (env.get_observations(), observations):
        shapes = {name: tuple(group[name].shape) for name in group.keys()}  # noqa: SIM118
        assert shapes == {
            "history": (5, 510),
            "command": (5, 5),
            "clock": (5, 12 if harmonics else 2),
            "critic": (5, env.layout.size("critic")),
            "estimate": (5, 33 if embodiment else 3),
            "slot_mask": (5, 32),
            "phase": (5,),
            "robot": (5,),
        }
        assert all(x.dtype == torch.float32 for name, x in group.items() if name != "robot")
        assert all(torch.isfinite(x).all() for name, x in group.items())
    assert rewards.shape == dones.shape == extras["time_outs"].shape == (5,)
    assert rewards.dtype == torch.float32
    assert dones.dtype == extras["time_outs"].dtype == torch.bool
    assert env.max_episode_length == 1000
    assert env.step_dt == pytest.approx(0.02)
    for name, (perm, sign) in env.mirror.items():
        columns = 32 if name == "actions" else observations[name].shape[1]
        assert sorted(perm.tolist()) == list(range(columns)), name
        assert sign.abs().eq(1).all(), name


def test_too_few_environments_are_refused() -> None:
    with pytest.raises(ConfigError, match="num_envs"):
        make_env(num_envs=1)


def test_the_newest_frame_comes_first_and_older_ones_move_back() -> None:
    env = make_env(task=BARE)
    frames = [env.get_observations()["history"].reshape(4, 5, -1)]
    for observations, _ in rollout(env, 4):
        frames.append(observations["history"].reshape(4, 5, -1))
        assert torch.equal(frames[-1][:, 1:], frames[-2][:, :-1])
        assert torch.equal(frames[-1][:, 0], proprioception(env.state, env.robots, BARE.observations).float())


@pytest.mark.parametrize("row", [0, 2, 3])
def test_a_fall_leaves_every_other_environment_untouched(row: int) -> None:
    quiet, disturbed = make_env(num_envs=5), make_env(num_envs=5)
    for first, second in zip(rollout(quiet, 4), rollout(disturbed, 4), strict=True):
        assert_same(first[0], second[0], "before anything happened")
    topple(disturbed, row)
    rest = others(quiet, row)
    for step in range(4, 16):
        first, second = quiet.step(actions(5, step)), disturbed.step(actions(5, step))
        assert_same(first[0], second[0], f"environment {row} fell, others changed", rest)
        assert torch.equal(first[1][rest], second[1][rest]), "rewards"
        assert torch.equal(first[2][rest], second[2][rest]), "dones"
        if step == 4:
            assert second[2].tolist() == [i == row for i in range(5)]
            assert not second[3]["time_outs"].any(), "a fall is no time-out"


def test_an_episode_starts_with_a_clean_slate() -> None:
    env = make_env(task=BARE)
    for _ in rollout(env, 3):
        pass
    topple(env, 1)
    observations, _, dones, _ = env.step(actions(4, 3))
    assert dones.tolist() == [False, True, False, False]
    frames = observations["history"].reshape(4, 5, -1)
    assert torch.equal(frames[1], frames[1, :1].expand(5, -1)), "history holds the first frame only"
    assert not env.state.actions[1].any()
    assert not env.state.last_actions[1].any()
    assert env.episode_length_buf.tolist() == [4, 0, 4, 4]
    fresh = make_env(task=BARE)
    assert torch.equal(frames[1, 0], fresh.get_observations()["history"][1, :102]), "the default pose"


def test_what_a_reset_or_a_new_command_changes_is_observed_as_if_all_were_observed_anew() -> None:
    """A reset and a new command touch their own rows of the observations only, and must touch every column there."""
    quick = replace(TaskCfg(), commands=CommandsCfg(resampling_time_s=0.1))
    env, ends, draws = make_env(num_envs=5, task=quick), 0, 0
    for step in range(14):
        if step in (3, 8):
            topple(env, step % 5)
        before = env.commands.count.clone()
        observations, _, dones, _ = env.step(actions(5, step))
        env._forget()
        whole = env.get_observations()
        assert not env.state.joint_acc[dones].any(), "an episode begins without a past"
        assert not env.state.last_foot_contact[dones].any()
        ends, draws = ends + int(dones.sum()), draws + int((env.commands.count - before).sum())
        for name, value in whole.items():
            torch.testing.assert_close(observations[name], value, rtol=0.0, atol=1e-6, msg=f"{name}, step {step}")
    assert ends >= 2
    assert draws > ends, "no command was drawn in the middle of an episode"


def test_a_state_knows_the_joint_velocities_and_contacts_of_the_step_before() -> None:
    env = make_env(num_envs=5)
    for step in range(40):
        before = env.state
        dones = env.step(actions(5, step))[2]
        moved = (env.state.joint_vel - before.joint_vel) / env.step_dt
        torch.testing.assert_close(env.state.joint_acc[~dones], moved[~dones])
        assert torch.equal(env.state.last_foot_contact[~dones], before.foot_contact[~dones])
    assert before.foot_contact.any(), "nobody ever stood"


def test_penalties_are_weighted_anew_when_their_curriculum_goes_on() -> None:
    rewards = RewardsCfg(penalty_interval_steps=2)
    env = make_env(task=replace(TaskCfg(), rewards=rewards))
    for step in range(5):
        env.step(actions(4, step))
        expected = reward_factors(rewards.weights, 0.2 ** (0.8 ** ((step + 1) // 2)), env.step_dt, env.phase)
        assert torch.equal(env._reward_factors, expected), step


def test_what_was_handed_out_keeps_its_values() -> None:
    env = make_env(num_envs=5)
    env.step(actions(5, 0))
    handed_out, state = env.get_observations(), env.state
    copies = handed_out.clone(), state.root_pos_w.clone(), state.joint_vel.clone()
    topple(env, 1)
    env.step(actions(5, 1))
    later = env.state
    root_pos = later.root_pos_w.clone()
    observed = env.get_observations()
    history = observed["history"].clone()
    env.reset()
    assert torch.equal(observed["history"], history)
    assert torch.equal(later.root_pos_w, root_pos)
    assert_same(handed_out, copies[0], "observations")
    assert torch.equal(state.root_pos_w, copies[1])
    assert torch.equal(state.joint_vel, copies[2])


def test_time_outs_come_at_the_time_limit_only_and_carry_the_true_last_observations() -> None:
    """The last observation equals the one an environment with a longer limit gives at the same step."""
    limited, endless = make_env(task=SHORT), make_env()
    assert limited.max_episode_length == 10
    for step in range(12):
        _, _, dones, extras = limited.step(actions(4, step, 0.0))
        longer = endless.step(actions(4, step, 0.0))[0] if step < 10 else None
        expected = step == 9
        assert extras["time_outs"].tolist() == dones.tolist() == [expected] * 4
        assert extras["final_ids"].tolist() == ([0, 1, 2, 3] if expected else [])
        assert extras["final_observations"].batch_size == torch.Size([4 if expected else 0])
        if expected and longer is not None:
            assert_same(extras["final_observations"], longer, "last observations before the reset")


def test_returns_are_cut_where_a_new_command_or_a_push_comes_with_the_command_before_it() -> None:
    """Commands every 5 steps; pushes before the 8th and 16th; a robot that fell is cut by its fall alone."""
    task = replace(
        TaskCfg(),
        commands=CommandsCfg(resampling_time_s=0.1, redraw_after_fall=False),
        randomization=RandomizationCfg(push_interval_s=0.16),
    )
    env, same = make_env(task=task), make_env(task=replace(task, commands=CommandsCfg(resampling_time_s=10.0)))
    for step in range(1, 20):
        if step == 10:
            topple(env, 2)
        before, dones = env.get_observations()["command"], torch.tensor([False, False, step == 10, False])
        after, _, ended, extras = env.step(actions(4, step, 0.0))
        unmoved = same.step(actions(4, step, 0.0))[0]
        assert torch.equal(ended, dones)
        cut = [0, 1, 2, 3] if step in (5, 7, 15) else [0, 1, 3] if step == 10 else []
        assert extras["final_ids"].tolist() == cut, f"returns cut at step {step}"
        assert torch.equal(extras["final_observations"]["command"], before[extras["final_ids"]])
        if step == 5:
            assert not torch.equal(after["command"], before), "no new command came, so the test shows nothing"
            assert_same(extras["final_observations"], unmoved, "as if the old command went on")


def test_for_gymnasium_only_ended_episodes_have_last_observations() -> None:
    env = make_env(task=replace(TaskCfg(), commands=CommandsCfg(resampling_time_s=0.02)))
    env.final_of_episodes = True
    topple(env, 1)
    assert env.step(actions(4, 0))[3]["final_ids"].tolist() == [1]


def test_a_full_episode_lasts_a_thousand_steps() -> None:
    env = make_env(names=["h1"], num_envs=1)
    env.episode_length_buf = torch.tensor([998])
    assert not env.step(actions(1, 0, 0.0))[3]["time_outs"].any()
    assert env.step(actions(1, 1, 0.0))[3]["time_outs"].all()


def test_staggered_episodes_end_at_different_times_but_together_with_others_even_after_falls() -> None:
    task = replace(BARE, terminations=TerminationsCfg(episode_length_s=3.0))  # 150 steps
    env = make_env(["h1"], num_envs=12, task=task)
    torch.manual_seed(1)
    env.stagger()
    assert env.episode_length_buf.unique().numel() > 5, "they are to end at different times"
    began, lengths, met = -env.episode_length_buf, [], set()
    for step in range(1, 400):
        if step % 37 == 0:
            topple(env, step % 12)
        _, _, dones, extras = env.step(actions(12, step, 0.0))
        over = extras["time_outs"]
        met |= {step % 3} if over.any() else set()
        lengths += (step - began)[over].tolist()
        began = torch.where(dones, step, began)
        assert torch.equal(env.episode_length_buf, torch.where(dones, step % 3, env.episode_length_buf))
    assert len(met) == 1, f"time limits were met at steps that are {met} modulo 3"
    assert min(lengths) >= 148
    assert max(lengths) == 150
    again = make_env(["h1"], num_envs=12, task=task)
    again.load_state_dict(env.state_dict())
    assert again._stagger == env._stagger == 3, "a resumed run goes on alike"


def test_actions_in_absent_slots_change_nothing() -> None:
    plain, noisy = make_env(), make_env()
    absent = noisy.robots.slot_mask == 0
    for step in range(30):
        command = actions(4, step)
        first = plain.step(command)
        second = noisy.step(torch.where(absent, torch.full_like(command, 50.0 * (step - 15)), command))
        assert_same(first[0], second[0], "an absent slot was used")
        assert torch.equal(first[1], second[1]), "rewards"


@pytest.mark.parametrize("name", ["h1", "g1", "t1"])
def test_a_robot_does_the_same_alone_and_in_company(name: str) -> None:
    fleet = ["h1", "g1", "t1"]
    task = replace(TaskCfg(), control=ControlCfg(posture_reference=1.0))
    pooled, alone = make_env(fleet, 9, task), make_env([name], 3, task)
    rows = slice(3 * fleet.index(name), 3 * fleet.index(name) + 3)
    for step in range(60):
        command = actions(3, step).repeat(3, 1)
        first, second = pooled.step(command), alone.step(command[:3])
        for group in ("history", "command", "clock", "critic", "estimate", "slot_mask"):
            assert torch.equal(first[0][group][rows], second[0][group]), f"{name} in company: {group}, step {step}"
        assert torch.equal(first[1][rows], second[1]), "rewards"
        assert torch.equal(first[2][rows], second[2]), "dones"


def test_physics_threads_change_no_bit() -> None:
    for one, two in zip(rollout(make_env(), 30), rollout(make_env(threads=2), 30), strict=True):
        assert_same(one[0], two[0], "the number of threads was changed")


def test_what_was_handed_out_is_not_written_again() -> None:
    env = make_env(task=SHORT)
    handed: list[tuple[TensorDict, TensorDict]] = []
    for step in range(22):
        before = env.get_observations()
        after, rewards, dones, extras = env.step(actions(4, step))
        values = {"rewards": rewards, "dones": dones, "time_outs": extras["time_outs"], "state": env.state.joint_pos}
        given = TensorDict({"before": before, "after": after, "final": extras["final_observations"], **values})
        handed.append((given, given.clone()))
    topple(env, 0)
    env.pin_commands(torch.zeros(4, 5))
    env.step(actions(4, 22))
    for given, copy in handed:
        assert (given == copy).all()


def test_logs_are_fresh_and_read_now_and_then() -> None:
    env = make_env()
    entries = [env.step(actions(4, step))[3]["log"] for step in range(2 * LOG_INTERVAL)]
    filled = [step for step, entry in enumerate(entries) if entry]
    assert filled == [LOG_INTERVAL - 1, 2 * LOG_INTERVAL - 1]
    assert entries[filled[0]] is not entries[filled[1]]
    for robot in ("h1", "g1"):
        assert f"Metrics/E_vx/{robot}" in entries[filled[0]]


def test_no_global_random_state_is_touched() -> None:
    before = torch.get_rng_state(), np.random.get_state(legacy=False)["state"]["key"].copy(), random.getstate()
    env = make_env(task=SHORT)
    for _ in rollout(env, 12):
        pass
    assert torch.equal(torch.get_rng_state(), before[0]), "torch"
    assert np.array_equal(np.random.get_state(legacy=False)["state"]["key"], before[1]), "numpy"
    assert random.getstate() == before[2], "random"


def test_pinned_commands_stay_in_force_until_released() -> None:
    task = replace(SHORT, commands=CommandsCfg(resampling_time_s=0.1))
    env = make_env(task=task)
    pinned = torch.tensor([[0.4, 0.1, -0.2, -0.1, 0.2]]).repeat(4, 1)
    pinned[2, :3] = 0.0
    env.pin_commands(pinned)
    for _ in rollout(env, 25):
        assert torch.equal(env.command, pinned)
        assert env.state.standing.tolist() == [False, False, True, False]
    env.pin_commands(None)
    for _ in rollout(env, 6):
        pass
    assert not torch.equal(env.command, pinned)
    assert len(env.command.unique(dim=0)) == 4


@pytest.mark.parametrize("pinned", [True, False])
def test_a_window_in_which_commands_were_pinned_opens_nothing(pinned: bool) -> None:
    env = make_env()
    sampler, before = env.commands.sampler, env.commands.sampler.weights.clone()
    sampler.sums, sampler._creditable[:] = torch.full_like(sampler.sums, 1e9), True
    if pinned:
        env.pin_commands(torch.zeros(4, 5))
        env.pin_commands(None)
    env.commands.draw(torch.arange(4))
    assert torch.equal(sampler.weights, before) is pinned, "what was pinned is no success of what was sampled"


def test_commands_are_redrawn_at_the_interval() -> None:
    env = make_env(task=replace(TaskCfg(), commands=CommandsCfg(resampling_time_s=0.1)))
    commands = [env.command, *(env.command for _ in rollout(env, 12, scale=0.0))]
    redrawn = [i for i in range(1, 13) if not torch.equal(commands[i], commands[i - 1])]
    assert redrawn == [5, 10]


@pytest.mark.parametrize("redraw", [True, False])
def test_after_a_fall_the_old_command_ends_or_lasts_as_configured(redraw: bool) -> None:
    commands = CommandsCfg(resampling_time_s=0.1, redraw_after_fall=redraw)
    env = make_env(task=replace(TaskCfg(), commands=commands))
    for _ in rollout(env, 3, scale=0.0):
        pass
    before = env.command
    env._reset(torch.tensor([0, 1]), torch.tensor([True, False]))
    kept = (env.command == before).all(dim=1).tolist()
    assert kept == [not redraw, False, True, True], "environment 0 fell, 1 timed out, 2 and 3 went on"
    for _ in rollout(env, 2, scale=0.0):
        pass
    assert not torch.equal(env.command[0], before[0]), "a command never lasts longer than its time"


def test_the_curriculum_goes_by_what_all_processes_saw() -> None:
    """Another process falls all the time and never steps, but has opened every command."""
    alone, together = make_env(), make_env()
    others = {"mean": lambda x: torch.tensor([[1.0], [0.0]]).expand_as(x), "max": torch.ones_like}
    together.over_processes = lambda x, how: others[how](x)
    for env in (alone, together):
        for _ in rollout(env, LOG_INTERVAL):
            pass
    assert not (alone.commands.sampler.weights > 0).all()
    assert (together.commands.sampler.weights == 1).all()
    state = together.aids.state_dict()
    assert (state["_episode_ratio"] < alone.aids.state_dict()["_episode_ratio"]).all()
    assert not state["_contact_match"].any()


def test_nothing_holds_the_bases_once_the_last_harness_is_gone() -> None:
    env = make_env(num_envs=5, task=replace(TaskCfg(), aids=AidsCfg(harness=0.5)))
    env.step(actions(5, 0))
    held = [batch._batch.bind("xfrc_applied") for batch in env.pool.batches]
    assert all(force.any() for force in held)
    env.aids.harness[:] = 0.0
    env._apply_aids()
    env.step(actions(5, 1))
    assert not any(force.any() for force in held)
