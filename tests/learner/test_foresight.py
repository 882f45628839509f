"""Foresight, in worlds whose errors are known beforehand."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from eagle_rl.algorithms.foresight import Trace, foresee
from eagle_rl.models.basis import monomials, products, waves
from eagle_rl.models.correction import CorrectedPolicy, Correction
from eagle_rl.models.foresight import MAX_CHANGE, Foresight
from tests.learner.test_correction import COMMAND_SIGN, JOINT_SIGN, MIRROR, PARTNER, correction, normal, toy

HISTORY = 6
HORIZON = 5
HISTORY_MIRROR = (torch.tensor([1, 0, 2, 4, 3, 5]), torch.tensor([-1.0, -1.0, 1.0, 1.0, 1.0, 1.0]))
YAW = 2
TOWARDS = torch.tensor([0.0, 2.0, -1.0, 0.5, 0.0, 0.0])
"""Yaw error of the next step, by the history."""
ANSWER = torch.tensor([3.0, 0.0, 4.0])
"""Of it, to a change of the joints' actions."""


def seen_world(steps: int = 14, robots: int = 500) -> Trace:
    """What is seen changes at random, and only the yaw error of the very next step follows from it."""
    history, change = normal(steps, robots, HISTORY), 0.1 * normal(steps, robots, 3, seed=1)
    history[..., 5] = 7.0  # an entry that says nothing
    error = torch.zeros(steps, robots, 5)
    error[..., YAW] = history @ TOWARDS + change @ ANSWER
    phase = torch.rand(steps, robots, generator=torch.Generator().manual_seed(2))
    return Trace(history, phase, torch.zeros(robots, 5), change, error)


def look(foresight: Foresight, trace: Trace) -> Tensor:
    """Changes asked for at the first step."""
    return foresight.change(trace.history[0], trace.phase[0], monomials(trace.command))


def test_products_pair_every_number_with_every_other():
    assert products(torch.tensor([1.0, 2.0]), torch.tensor([3.0, 5.0])).tolist() == [3.0, 5.0, 6.0, 10.0]


def test_errors_of_the_next_step_are_foreseen_and_later_ones_that_cannot_be_are_not():
    trace = seen_world()
    foresight = foresee([trace], HORIZON, damping=1.0)
    ahead = foresight.features(trace.history[0], trace.phase[0], monomials(trace.command)) @ foresight.weights
    first, later = ahead.unflatten(1, (HORIZON, 5))[:, 0], ahead.unflatten(1, (HORIZON, 5))[:, 1:]
    expected = trace.history[0] @ TOWARDS
    assert (first[:, YAW] - expected).abs().max() < 0.1 * expected.abs().max()
    assert later.std() < 0.2 * expected.std()


@pytest.mark.parametrize("damping", [0.0, 5.0, 20.0])
def test_the_change_takes_off_what_damping_leaves_of_the_error(damping):
    """By hand: joints that answer (3, 0, 4) take off 25 / (25 + damping squared) of an error."""
    trace = seen_world()
    change = look(foresee([trace], HORIZON, damping=max(damping, 1e-2)), trace)
    small = change.abs().amax(dim=1) < MAX_CHANGE
    error = (trace.history[0] @ TOWARDS)[small]
    left = error + change[small] @ ANSWER
    share = (left @ error) / (error @ error)
    assert share.item() == pytest.approx(1 - 25 / (25 + damping**2), abs=0.1)


def test_a_change_is_bounded_and_so_is_what_one_entry_of_the_history_can_ask_for():
    trace = seen_world()
    wild = trace.history.clone()
    wild[0, :, 1] = 100.0
    foresight = foresee([trace], HORIZON, damping=1.0)
    change = look(foresight, dataclasses.replace(trace, history=wild))
    assert change.abs().max() <= MAX_CHANGE
    wilder = wild.clone()
    wilder[0, :, 1] = 1000.0
    torch.testing.assert_close(look(foresight, dataclasses.replace(trace, history=wilder)), change)


def test_an_entry_of_the_history_that_never_changes_is_not_looked_at():
    assert foresee([seen_world()], HORIZON, damping=1.0).columns.tolist() == [0, 1, 2, 3, 4]


def test_what_is_learned_lies_in_memory_as_a_file_keeps_it():
    """Products of a matrix kept by columns differ in their last digits from those of the same one read from a file."""
    foresight = foresee([seen_world(robots=50)], HORIZON, damping=1.0)
    for name, x in foresight.state_dict().items():
        assert x.is_contiguous(), name
        assert x.untyped_storage().nbytes() == x.nbytes, f"{name}: the rest of its storage would be saved too"


def test_the_mirror_image_of_a_mirror_image_is_the_trace_a_cycle_later():
    trace = seen_world(robots=3)
    twice = trace.mirrored(MIRROR, HISTORY_MIRROR).mirrored(MIRROR, HISTORY_MIRROR)
    torch.testing.assert_close(twice.phase, trace.phase + 1.0)
    for name in ("history", "command", "change", "error"):
        torch.testing.assert_close(getattr(twice, name), getattr(trace, name), msg=name)


def test_learned_from_both_sides_a_mirrored_robot_is_answered_by_the_mirrored_change():
    trace = seen_world(robots=200)
    image = trace.mirrored(MIRROR, HISTORY_MIRROR)
    foresight = foresee([trace, image], HORIZON, damping=1.0)
    change, mirrored = look(foresight, trace), look(foresight, image)
    torch.testing.assert_close(mirrored, change[:, PARTNER] * JOINT_SIGN, atol=2e-3, rtol=0)
    assert torch.equal(image.command, trace.command * COMMAND_SIGN)


def foreseeing(damping: float = 2.0) -> Correction:
    """A correction of nothing but what is foreseen, of random weights, for the toy."""
    history = toy()[1]["history"].shape[1]
    columns = torch.arange(history)
    num_features, ahead = 21 * 56 + 3 * history, 5 * HORIZON
    foresight = Foresight(
        columns=columns,
        mean=torch.zeros(history),
        scale=torch.ones(history),
        weights=normal(num_features, ahead),
        answer=normal(5, 3, ahead, seed=1),
        damping=torch.tensor(damping),
    )
    return dataclasses.replace(correction(), foresight=foresight)


def test_a_policy_adds_what_is_foreseen_in_units_to_its_own_joints_and_nowhere_else():
    actor, obs = toy()
    some = foreseeing()
    more = CorrectedPolicy(actor, some)(obs) - actor(obs)
    assert some.foresight is not None
    basis = monomials(some.normalised(obs["command"]))
    expected = some.foresight.change(obs["history"], obs["phase"], basis) * some.units
    torch.testing.assert_close(more[:, some.slots], expected, atol=1e-5, rtol=0)
    more[:, some.slots] = 0.0
    assert not more.any()


def test_a_standing_robot_answers_nothing_that_it_foresees():
    actor, obs = toy()
    obs["clock"] = torch.ones_like(obs["clock"])
    torch.testing.assert_close(foreseeing().act(actor, obs), actor(obs))


def test_a_correction_is_what_its_state_says_with_and_without_foresight():
    actor, obs = toy()
    for some in (foreseeing(), correction(normal(56, 36))):
        again = Correction.from_state(some.state_dict())
        assert (again.foresight is None) == (some.foresight is None)
        torch.testing.assert_close(again.act(actor, obs), some.act(actor, obs))


def test_an_answer_follows_the_gait():
    """A joint that answers in one half of the cycle alone is asked in that half alone."""
    trace = seen_world(robots=2000)
    cosine = waves(trace.phase, 1)[..., 1]
    error = trace.error.clone()
    error[..., YAW] = trace.history @ TOWARDS + (1 + cosine) * (trace.change @ ANSWER)
    foresight = foresee([dataclasses.replace(trace, error=error)], HORIZON, damping=5.0)
    late = torch.full_like(trace.phase[:1], 0.5)
    asked = look(foresight, dataclasses.replace(trace, phase=torch.zeros_like(late))).abs().mean()
    assert look(foresight, dataclasses.replace(trace, phase=late)).abs().mean() < 0.2 * asked
