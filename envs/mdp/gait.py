"""Gait clock: the phase of each foot, when it should touch the ground and how high it should swing.

A foot's phase runs through [0, 1): stance first, then swing. Sources: paper, Eq. clock; HugWBC 1.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from eagle_rl.config.schema import GaitCfg

STANDING_PHASE = 0.25
"""Phase of both feet while standing: the middle of stance, so that C = 1 and the clock reads (1, 1) (HugWBC 1)."""


def advance_phase(phase: Tensor, step_dt: float, frequency: Tensor) -> Tensor:
    """Base phase one control step later, ``(phi + f dt) mod 1`` (paper, Eq. clock).

    Args:
        phase: base phase [cycles], shape (N,).
        step_dt: control step [s].
        frequency: of each robot's gait [Hz], shape (N,).

    Returns:
        Shape (N,), in [0, 1).
    """
    return torch.remainder(phase + frequency * step_dt, 1.0)


def foot_phases(phase: Tensor, standing: Tensor, cfg: GaitCfg) -> Tensor:
    """Phase of each foot: the right foot has the base phase, the left one is ahead by the offset.

    Args:
        phase: base phase [cycles], shape (N,).
        standing: whether all velocity commands are zero, bool, shape (N,).
        cfg: phase offset.

    Returns:
        Phases of (left, right), shape (N, 2); 0.25 for both while standing.
    """
    phases = torch.stack((torch.remainder(phase + cfg.phase_offset, 1.0), phase), dim=1)
    return phases.masked_fill(standing.unsqueeze(1), STANDING_PHASE)


def homogenise(phase: Tensor, stance_ratio: float) -> Tensor:
    """Stretch phases so that stance fills [0, 0.5) and swing [0.5, 1); the identity for a stance ratio of 0.5."""
    if stance_ratio == 0.5:
        return phase
    stance = 0.5 * phase / stance_ratio
    swing = 0.5 + 0.5 * (phase - stance_ratio) / (1.0 - stance_ratio)
    return torch.where(phase < stance_ratio, stance, swing)


def contact_probability(foot_phase: Tensor, cfg: GaitCfg) -> Tensor:
    """C(phi), the desired probability of contact: 1 in stance, 0 in swing, with Gaussian edges (HugWBC 1).

    Two windows are summed, this cycle's stance and the next one's.

    Args:
        foot_phase: phase of each foot [cycles], shape (N, 2).
        cfg: stance ratio and smoothing of the edges.

    Returns:
        Shape (N, 2), in [0, 1].
    """
    slopes, offsets = _stance_edges(cfg.contact_smoothing, foot_phase.dtype, foot_phase.device)
    phase = homogenise(foot_phase.flatten(), cfg.stance_ratio)
    begun, not_over, next_begun, next_not_over = torch.erfc(torch.addcmul(offsets, phase, slopes))
    probability = 0.25 * (begun * not_over + next_begun * next_not_over)
    # A view that makes a kernel compute what it views as it is: in vectors of all feet instead of two.
    return probability.as_strided(foot_phase.shape, (foot_phase.shape[1], 1))


@lru_cache(maxsize=16)
def _stance_edges(smoothing: float, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Slopes and offsets, shape (4, 1), that bring a phase to the arguments of erfc at the edges of both stances."""
    signs, edges = torch.tensor(((-1.0, 1.0, -1.0, 1.0), (0.0, 0.5, 1.0, 1.5)), dtype=dtype, device=device)[..., None]
    slopes = signs / (smoothing * math.sqrt(2.0))
    return slopes, -slopes * edges


def swing_target(foot_phase: Tensor, swing_height: Tensor, cfg: GaitCfg) -> Tensor:
    """l_target, the desired height of each sole above the ground: a quintic with its apex at mid-swing (HugWBC 1).

    Velocity and acceleration vanish at lift-off, apex and touch-down.

    Args:
        foot_phase: phase of each foot [cycles], shape (N, 2).
        swing_height: apex of each robot [m], shape (N,).
        cfg: stance ratio.

    Returns:
        Height [m], shape (N, 2); 0 in stance.
    """
    rise = (1.0 - (homogenise(foot_phase, cfg.stance_ratio) - 0.75).abs() * 4.0).clamp(min=0.0)
    return swing_height.unsqueeze(1) * rise**3 * (10.0 + rise * (6.0 * rise - 15.0))


def clock(foot_phase: Tensor) -> Tensor:
    """Clock observation ``sin(2 pi phi)`` of (left, right), shape (N, 2) (paper, Eq. clock)."""
    return torch.sin(2.0 * math.pi * foot_phase)


def clock_harmonics(foot_phase: Tensor, count: int) -> Tensor:
    """What the sine of :func:`clock` does not tell: cos(2 pi phi), sin(4 pi phi), cos(4 pi phi), sin(6 pi phi), ...

    Args:
        foot_phase: (left, right) [cycles], shape (N, 2).
        count: highest multiple of the gait's frequency, at least 1.

    Returns:
        Left and right side by side for each wave, shape (N, 4 count - 2).
    """
    multiples = torch.arange(1, count + 1, dtype=foot_phase.dtype, device=foot_phase.device)
    angle = 2.0 * math.pi * multiples[:, None] * foot_phase.unsqueeze(1)
    return torch.stack((torch.sin(angle), torch.cos(angle)), dim=2).flatten(1)[:, 2:]
