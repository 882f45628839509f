"""Corrections, against policies whose answers are known."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.algorithms.correction import (
    ERROR_HARMONICS,
    MAX_HARM,
    Mirror,
    Probe,
    error_waves,
    expected_harm,
    improve,
)
from eagle_rl.algorithms.specialists import SpecialistBank
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.models.basis import monomials, waves
from eagle_rl.models.correction import DOUBT, NUM_HARMONICS, NUM_SHIFTS, SHIFT_UNIT, CorrectedPolicy, Correction
from tests.learner.helpers import make_runner
from tests.toy import ToyEnv

SLOTS = torch.tensor([0, 2, 5])
PARTNER, JOINT_SIGN = torch.tensor([1, 0, 2]), torch.tensor([-1.0, -1.0, 1.0])
COMMAND_SIGN = torch.tensor([1.0, -1.0, -1.0, 1.0, 1.0])
MIRROR = Mirror(command=(torch.arange(5), COMMAND_SIGN), partner=PARTNER, sign=JOINT_SIGN)
WIDTH = len(SLOTS) * (2 * NUM_HARMONICS + 1) + NUM_SHIFTS
NUM_ERRORS = 2 * ERROR_HARMONICS + 1
TERMS = 56
"""Monomials of five commands up to degree three."""


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def correction(weights: Tensor | None = None) -> Correction:
    """One pass, trusted everywhere, for commands from 1 to 3."""
    weights = torch.zeros(TERMS, WIDTH) if weights is None else weights
    none = Correction(
        weights=torch.zeros(0, TERMS, WIDTH),
        slots=SLOTS,
        units=torch.tensor([1.0, 1.0, 0.5]),
        middle=torch.full((5,), 2.0),
        half_range=torch.ones(5),
        gains=torch.zeros(0, len(SLOTS), 3),
        harm=torch.zeros(0, TERMS),
        yaw_scales=torch.tensor([0.5, 2.0]),
    )
    return none.with_pass().last(weights=weights)


def even_correction() -> Correction:
    """For commands from -1 to 1, as a mirror needs them."""
    return dataclasses.replace(correction(), middle=torch.zeros(5))


def toy(waves: int = 0) -> tuple:
    """A policy and what it sees, walking; the phases are of a quarter cycle and more."""
    runner = make_runner(env=ToyEnv(waves=waves))
    obs = runner.env.get_observations()
    return runner.alg.actor, obs.update({"phase": torch.linspace(0.25, 0.9, len(obs))})


def test_waves_are_the_constant_and_the_harmonics_in_pairs():
    expected = [1.0, 0.0, 1.0, -1.0, 0.0]
    torch.testing.assert_close(waves(torch.tensor([0.25]), 2), torch.tensor([expected]), atol=1e-6, rtol=0)


def test_monomials_of_five_commands_go_up_to_degree_three():
    found = monomials(torch.tensor([[2.0, 3.0, 0.0, 0.0, 0.0]]))[0]
    assert found[:3].tolist() == [1.0, 2.0, 3.0]
    assert found[6:8].tolist() == [4.0, 6.0], "v_x v_x, v_x v_y"
    assert found[21:23].tolist() == [8.0, 12.0], "v_x v_x v_x, v_x v_x v_y"
    assert len(found) == TERMS == 1 + 5 + 15 + 35


@given(st.integers(1, ERROR_HARMONICS), st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2))
def test_an_error_is_split_into_its_mean_and_the_harmonics_it_is_made_of(k, mean, cosine, sine):
    phase = torch.linspace(0.0, 3.0, 100).unsqueeze(1)
    angle = 2 * math.pi * k * phase
    error = mean + cosine * torch.cos(angle) + sine * torch.sin(angle)
    found = error_waves(error.unsqueeze(2).expand(-1, -1, 5), phase)[0, 3]
    expected = torch.zeros(NUM_ERRORS)
    expected[[0, 2 * k - 1, 2 * k]] = torch.tensor([mean, cosine * math.sqrt(0.5), sine * math.sqrt(0.5)])
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)


def test_without_weights_a_policy_acts_as_it_did():
    actor, obs = toy()
    torch.testing.assert_close(CorrectedPolicy(actor, correction())(obs), actor(obs))


def test_a_joint_gets_its_harmonics_and_nobody_else_does():
    actor, obs = toy()
    weights = torch.zeros(TERMS, WIDTH)
    weights[0, (2 * NUM_HARMONICS + 1) + 2] = 0.5  # of the second joint, the sine of the phase
    more = correction(weights).act(actor, obs) - actor(obs)
    torch.testing.assert_close(more[:, 2], 0.5 * torch.sin(2 * math.pi * obs["phase"]))
    more[:, 2] = 0.0
    assert more.abs().max() < 1e-6


def test_a_coefficient_is_an_angle_where_an_action_is_worth_more_or_less_of_it():
    actor, obs = toy()
    weights = torch.zeros(TERMS, WIDTH)
    weights[0, 2 * (2 * NUM_HARMONICS + 1)] = 0.5  # of the third joint, the constant; its unit is 0.5
    more = correction(weights).act(actor, obs) - actor(obs)
    torch.testing.assert_close(more[:, 5], torch.full((len(obs),), 0.25))


def test_a_policy_is_told_more_of_a_velocity_in_shift_units():
    actor, obs = toy()
    weights = torch.zeros(TERMS, WIDTH)
    weights[0, -NUM_SHIFTS + 1] = 0.1
    told = obs.clone()
    told["command"][:, 1] += 0.1 * SHIFT_UNIT
    torch.testing.assert_close(correction(weights).act(actor, obs), actor(told))


def test_a_joint_answers_what_the_robot_turns_too_fast_by_a_gain_that_follows_the_phase():
    actor, obs = toy()
    obs["history"][:, 2], obs["command"][:, 2] = 0.5 * 0.7, 2.0 * 0.3  # turns at 0.7 rad/s, told 0.3 rad/s
    gains = torch.zeros(3, 3)
    gains[1] = torch.tensor([0.5, 0.0, 0.25])
    more = correction().last(gains=gains).act(actor, obs) - actor(obs)
    torch.testing.assert_close(more[:, 2], 0.4 * (0.5 + 0.25 * torch.sin(2 * math.pi * obs["phase"])))
    more[:, 2] = 0.0
    assert more.abs().max() < 1e-6
    extra = torch.zeros(len(obs), 3, 3)
    extra[0, 1] = gains[1]
    trial = correction().act(actor, obs, extra_gains=extra) - actor(obs)
    assert trial[0, 2] != 0.0
    assert trial[1:].abs().max() < 1e-6, "each robot tries gains of its own"


def test_a_standing_robot_is_not_corrected():
    actor, obs = toy()
    obs["clock"] = torch.ones_like(obs["clock"])
    some = correction(normal(TERMS, WIDTH)).last(gains=normal(3, 3))
    torch.testing.assert_close(some.act(actor, obs), actor(obs))


def test_a_standing_robot_is_known_by_the_sines_of_its_feet_whatever_the_harmonics():
    actor, obs = toy(waves=10)
    obs["clock"][:, :2], obs["clock"][:, 2:] = 1.0, -1.0
    torch.testing.assert_close(correction(normal(TERMS, WIDTH)).act(actor, obs), actor(obs))


def test_passes_add_up_each_where_it_is_trusted():
    """The first helps where v_x is large, the second where it is small, both by far more than doubt."""
    first, second = normal(2, TERMS, WIDTH)
    harm = torch.zeros(2, TERMS)
    harm[:, 1] = torch.tensor([-20.0, 20.0]) * DOUBT
    both = correction(first).last(harm=harm[0], gains=torch.ones(3, 3)).with_pass().last(weights=second, harm=harm[1])
    small, large = torch.full((1, 5), 1.0), torch.full((1, 5), 3.0)
    for command, weights, gain in ((large, first, 1.0), (small, second, 0.0)):
        coefficients, gains = both.at(command)
        torch.testing.assert_close(coefficients, correction(weights).at(command)[0], atol=1e-5, rtol=0)
        torch.testing.assert_close(gains, torch.full((1, 3, 3), gain), atol=1e-6, rtol=0)


def test_before_its_first_pass_and_with_an_empty_one_a_correction_adds_nothing():
    none = dataclasses.replace(correction(), **{n: getattr(correction(), n)[:0] for n in ("weights", "gains", "harm")})
    for each in (none, none.with_pass()):
        assert not any(x.any() for x in each.at(normal(4, 5)))


def test_harm_is_expected_where_it_was_seen_at_mirrored_commands_too():
    command = 2 * torch.rand(400, 5, generator=torch.Generator().manual_seed(1)) - 1
    harm = 0.5 * command[:, 0] * command[:, 1].abs() - 0.1
    expected = expected_harm(even_correction(), command, harm, MIRROR)
    corners = torch.tensor([[1.0, 0.9, 0, 0, 0], [1.0, -0.9, 0, 0, 0], [-1.0, 0.9, 0, 0, 0]])
    found = monomials(corners) @ expected
    assert (found[:2] > 0.2).all(), found
    assert found[2] < -0.3, found
    torch.testing.assert_close(found[0], found[1], msg="left and right are alike")


def test_one_that_falls_does_not_outvote_all_others():
    command, harm = torch.zeros(50, 5), torch.full((50,), -0.3)
    harm[0] = 14.0
    expected = expected_harm(even_correction(), command, harm, MIRROR)[0].item()
    assert expected == pytest.approx((49 * -0.3 + MAX_HARM) / 50, abs=0.01)


def test_beyond_the_commands_it_was_made_for_a_correction_stays_what_it_is_at_their_end():
    some = correction(normal(TERMS, WIDTH))
    ends, beyond = torch.tensor([[1.0, 3.0, 2.0, 3.0, 1.0]]), torch.tensor([[-9.0, 9.0, 2.0, 4.0, 0.0]])
    torch.testing.assert_close(some.at(beyond), some.at(ends))


def test_the_mirror_image_of_a_mirror_image_is_the_probe():
    probe = Probe(normal(4, 5), normal(4, WIDTH, seed=1), normal(4, 5, NUM_ERRORS), normal(4, 5, NUM_ERRORS, seed=2))
    once = MIRROR.both(probe)
    twice = MIRROR.both(once.of(torch.arange(4, 8)))
    for name in ("command", "change", "answer", "error"):
        torch.testing.assert_close(getattr(once, name)[:4], getattr(probe, name), msg=name)
        torch.testing.assert_close(getattr(twice, name)[4:], getattr(probe, name), msg=f"{name}, there and back")


def test_half_a_cycle_later_the_other_side_does_the_same():
    """The right knee's change at a phase is the left one's, with its sign, half a cycle later."""
    probe = Probe(normal(1, 5), normal(1, WIDTH), normal(1, 5, NUM_ERRORS), normal(1, 5, NUM_ERRORS))
    own, image = MIRROR.both(probe).change[:, :-NUM_SHIFTS].unflatten(1, (3, -1))
    phase = torch.linspace(0, 1, 7)
    left = waves(phase, NUM_HARMONICS) @ own[0]
    torch.testing.assert_close(waves(phase + 0.5, NUM_HARMONICS) @ image[1], -left, atol=1e-5, rtol=0)


def linear_world(seed: int = 0) -> tuple[Tensor, Tensor]:
    """Errors as polynomials of the command, (56, 5 B), and how they answer to a change, (C, 5 B).

    Both are their own mirror images, as those of a robot are.
    """
    sign = (COMMAND_SIGN.unsqueeze(1) * half_cycle()).flatten()
    odd = monomials(COMMAND_SIGN.unsqueeze(0))[0]
    errors = normal(TERMS, 5 * NUM_ERRORS, seed=seed) * (odd.unsqueeze(1) == sign)
    answer = normal(WIDTH, 5 * NUM_ERRORS, seed=seed + 1)
    images = [
        MIRROR.both(
            Probe(torch.zeros(1, 5), row.unsqueeze(0), torch.zeros(1, 5, NUM_ERRORS), torch.zeros(1, 5, NUM_ERRORS))
        )
        for row in torch.eye(WIDTH)
    ]
    swap = torch.stack([image.change[1] for image in images])
    return errors, 0.5 * (answer + swap @ answer * sign)


def half_cycle() -> Tensor:
    return torch.tensor([1.0] + [(-1.0) ** k for k in range(1, ERROR_HARMONICS + 1) for _ in range(2)])


def probed(errors: Tensor, answer: Tensor, std: float = 0.03) -> Probe:
    command, change = 2 * torch.rand(400, 5, generator=torch.Generator().manual_seed(9)) - 1, std * normal(400, WIDTH)
    return Probe(
        command=command,
        change=change,
        answer=(change @ answer).unflatten(1, (5, NUM_ERRORS)),
        error=(monomials(command) @ errors).unflatten(1, (5, NUM_ERRORS)),
    )


def left_over(step: Tensor, errors: Tensor, answer: Tensor, probe: Probe) -> float:
    """Mean square of the errors after a step, as a share of what there was."""
    basis = monomials(probe.command)
    before = basis @ errors
    return ((before + basis @ step @ answer).square().sum() / before.square().sum()).item()


def test_a_step_takes_off_what_the_joints_can_take_off():
    errors, answer = linear_world()
    reachable = errors @ answer.T @ torch.linalg.pinv(answer @ answer.T) @ answer  # projected on what joints can do
    probe = probed(reachable, answer)
    step = improve(even_correction(), probe, MIRROR, std=0.03, damping=0.01)
    assert left_over(step, reachable, answer, probe) < 0.02


@pytest.mark.parametrize("seed", [1, 2])
def test_damping_makes_steps_smaller_and_never_makes_errors_larger(seed):
    errors, answer = linear_world(seed)
    probe = probed(errors, answer)
    steps = [improve(even_correction(), probe, MIRROR, std=0.03, damping=d) for d in (1.0, 10.0, 100.0)]
    sizes = [step.norm().item() for step in steps]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.1 * sizes[0]
    left = [left_over(step, errors, answer, probe) for step in steps]
    assert left[0] < left[1] < left[2] < 1.0


def test_specialists_label_what_they_do_with_their_correction():
    actor, obs = toy()
    some = correction(0.1 * normal(TERMS, WIDTH))
    bank = SpecialistBank([actor] * 3, [None, some, None])
    labels = bank.label(obs.unsqueeze(0))["teacher_action"][0]
    corrected = obs["robot"] == 1
    torch.testing.assert_close(labels[corrected], CorrectedPolicy(actor, some)(obs)[corrected])
    torch.testing.assert_close(labels[~corrected], actor(obs)[~corrected])


def test_a_correction_reads_what_policies_read_and_the_phase():
    actor, obs = toy()
    groups = (*ACTOR_INPUTS, "slot_mask", "phase")
    alone = TensorDict({name: obs[name] for name in groups}, batch_size=obs.batch_size)
    some = correction(normal(TERMS, WIDTH))
    torch.testing.assert_close(some.act(actor, alone), some.act(actor, obs))
