"""When an episode ends other than by its time limit (HugWBC 9)."""

from __future__ import annotations

import torch
from torch import Tensor

from eagle_rl.config.schema import TerminationsCfg

from ..state import PooledState

REASONS = ("fall_contact", "roll", "pitch")
"""Why a robot counts as fallen."""


def terminations(state: PooledState, cfg: TerminationsCfg) -> dict[str, Tensor]:
    """Which robots have fallen, by each of ``REASONS``.

    Args:
        state: state after the control step.
        cfg: limits of roll and pitch [rad].

    Returns:
        ``fall_contact`` (torso, pelvis or head on the ground), ``roll`` and ``pitch``, each bool, shape (N,).
    """
    contact = state.ground_contact if cfg.ground_contact else torch.zeros_like(state.ground_contact)
    return {
        "fall_contact": contact,
        "roll": state.base_roll.abs() > cfg.max_roll,
        "pitch": state.base_pitch.abs() > cfg.max_pitch,
    }
