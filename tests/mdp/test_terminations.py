from __future__ import annotations

import math

import pytest
import torch

from eagle_rl.config.schema import TerminationsCfg
from envs.mdp.terminations import terminations
from tests.states import quiet_state, random_robots

ROBOTS = random_robots(0)
DEFAULT = TerminationsCfg()


def causes(roll: float = 0.0, pitch: float = 0.0, contact: bool = False, cfg: TerminationsCfg = DEFAULT) -> set[str]:
    """Names of the terminations of a robot rolled or pitched by an angle."""
    state = quiet_state(ROBOTS)
    gravity = [math.sin(pitch), -math.sin(roll) * math.cos(pitch), -math.cos(roll) * math.cos(pitch)]
    state.projected_gravity_b = torch.tensor(gravity, dtype=torch.float64).expand_as(state.projected_gravity_b)
    state.ground_contact = torch.full_like(state.ground_contact, contact)
    return {name for name, fallen in terminations(state, cfg).items() if fallen.all()}


def test_standing_goes_on() -> None:
    assert causes() == set()


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_roll_and_pitch_end_the_episode_beyond_their_limits(sign: float) -> None:
    assert causes(roll=0.79 * sign) == set()
    assert causes(roll=0.81 * sign) == {"roll"}
    assert causes(pitch=0.99 * sign) == set()
    assert causes(pitch=1.01 * sign) == {"pitch"}


def test_lying_on_the_back_of_the_head_is_a_pitch_fall() -> None:
    assert "pitch" in causes(pitch=math.pi)


def test_ground_contact_ends_the_episode_unless_switched_off() -> None:
    assert causes(contact=True) == {"fall_contact"}
    assert causes(contact=True, cfg=TerminationsCfg(ground_contact=False)) == set()
