from __future__ import annotations

import math

import pytest
import torch

from eagle_rl.config.schema import GaitCfg
from envs.mdp.metrics import contact_match, tracking_errors
from tests.states import quiet_state, random_robots

ROBOTS = random_robots(0)


def test_tracking_errors_are_absolute_and_in_the_order_of_the_paper() -> None:
    state = quiet_state(ROBOTS)
    state.command = torch.tensor([1.0, -0.2, 0.5, -0.1, 0.3], dtype=torch.float64).expand_as(state.command)
    state.base_lin_vel_b = state.base_lin_vel_b + torch.tensor([1.1, 0.2, 9.0], dtype=torch.float64)
    state.base_ang_vel_b = state.base_ang_vel_b + torch.tensor([9.0, 9.0, 0.2], dtype=torch.float64)
    state.base_height = ROBOTS.nominal_height - 0.25
    gravity = torch.tensor([math.sin(0.1), 0.0, -math.cos(0.1)], dtype=torch.float64)
    state.projected_gravity_b = gravity.expand_as(state.projected_gravity_b)
    assert tracking_errors(state, ROBOTS)[0].tolist() == pytest.approx([0.1, 0.4, 0.3, 0.15, 0.2])


@pytest.mark.parametrize(
    ("phases", "forces", "expected"),
    [((0.25, 0.75), (100.0, 0.0), 1.0), ((0.25, 0.75), (100.0, 100.0), 0.5), ((0.75, 0.25), (100.0, 0.0), 0.0)],
)
def test_contact_match_compares_feet_with_the_clock(
    phases: tuple[float, float], forces: tuple[float, float], expected: float
) -> None:
    state = quiet_state(ROBOTS)
    state.foot_phase = torch.tensor(phases, dtype=torch.float64).expand_as(state.foot_phase)
    state.foot_force_w[..., 2] = torch.tensor(forces, dtype=torch.float64)
    assert contact_match(state, GaitCfg()).tolist() == [expected] * len(ROBOTS.robot_id)
