"""Learning aids, annealed to exactly zero: a virtual harness on the base, and a softer gait reward (ours).

Both have one scale per robot that decays while the robot no longer needs it; the harness returns where it falls.
Evaluation runs without either.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from eagle_rl.config.schema import AidsCfg

from ..geometry import from_yaw_frame
from ..state import PooledRobots, PooledState

_EPISODE_SMOOTHING = 0.2
"""Share of the newest interval in the running mean of episode lengths [-]; were it less, too much harness would go."""
_MATCH_SMOOTHING = 0.05
"""The same of contacts, which follow slowly [-]; few environments make both noisy."""
_SNAP = 0.01
"""Scale under which an aid is off [-]."""
_GRAVITY = 9.81

# The harness, per kilogram of robot; a robot topples with about m g h = 7 N m/rad/kg.
_TILT_STIFFNESS = 400.0 / 33.0
"""[N m/rad/kg]"""
_MAX_TILT_TORQUE = 120.0 / 33.0
"""[N m/kg]"""
_TILT_DAMPING = 12.0 / 33.0
"""[N m s/rad/kg]; part of the physics step and so implicit: as a torque held over a control step it would shake a light
pelvis apart."""
_SUPPORT = 0.35
"""Share of the weight the harness carries at the commanded height [-]; it makes lifting a foot affordable."""
_HEIGHT_STIFFNESS = 30.0
"""Change of the support below and above that height [N/m/kg]."""
_MAX_SUPPORT = 0.6
"""Share of the weight the harness carries at most [-]."""
_DRAG = 1.0
"""[N s/m/kg]"""
_MAX_DRAG = 0.15
"""Bound on the drag as a share of the weight [-]."""


class LearningAids:
    """Scales of both aids, one per robot."""

    _STATE = ("harness", "gait_shaping", "_episode_ratio", "_contact_match")

    def __init__(self, cfg: AidsCfg, num_robots: int, device: torch.device | str = "cpu") -> None:
        """Start both aids at their configured scales."""
        self.cfg = cfg
        self.harness = torch.full((num_robots,), cfg.harness, dtype=torch.float64, device=device)
        """Scale of the harness, shape (R,)."""
        self.gait_shaping = torch.full((num_robots,), cfg.gait_shaping, dtype=torch.float64, device=device)
        """Scale s of gait shaping, shape (R,)."""
        self._episode_ratio = torch.zeros_like(self.harness)
        self._contact_match = torch.zeros_like(self.harness)

    def update(self, episode_ratio: Tensor, contact_match: Tensor) -> None:
        """Decay what is no longer needed, and give a robot that falls some of its harness back.

        Call once per ``interval_steps``. A harness that is gone stays gone.

        Args:
            episode_ratio: mean episode length of each robot over the full length, shape (R,).
            contact_match: share of steps in which its feet agree with the clock, shape (R,).
        """
        cfg = self.cfg
        self._episode_ratio = torch.lerp(self._episode_ratio, episode_ratio.to(self._episode_ratio), _EPISODE_SMOOTHING)
        self._contact_match = torch.lerp(self._contact_match, contact_match.to(self._contact_match), _MATCH_SMOOTHING)
        falls = self._episode_ratio < cfg.harness_return_ratio
        stands = self._episode_ratio >= cfg.min_episode_ratio
        steps = self._contact_match >= cfg.harness_contact_match
        walks = self._contact_match >= cfg.min_contact_match
        returned = (self.harness * (1.0 + cfg.harness_decay)).clamp(max=cfg.harness)
        self.harness = torch.where(falls, returned, _decayed(self.harness, stands & steps, cfg.harness_decay))
        self.gait_shaping = _decayed(self.gait_shaping, walks & (self.harness == 0.0), cfg.gait_shaping_decay)

    def state_dict(self) -> dict[str, Tensor]:
        """Both scales and the running means that decide about their decay."""
        return {name: getattr(self, name).clone() for name in self._STATE}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name in self._STATE:
            setattr(self, name, state[name].to(self.harness))

    def log(self, robot_names: Sequence[str]) -> dict[str, float]:
        """Both scales of every robot."""
        scales = {"harness": self.harness.tolist(), "gait_shaping": self.gait_shaping.tolist()}
        return {
            f"Curriculum/{aid}/{name}": value
            for aid, values in scales.items()
            for name, value in zip(robot_names, values, strict=True)
        }


def _decayed(scale: Tensor, fulfilled: Tensor, decay: float) -> Tensor:
    """Scale one update later: smaller where the condition holds, exactly zero once it is negligible."""
    scale = torch.where(fulfilled, scale * (1.0 - decay), scale)
    return torch.where(scale < _SNAP, 0.0, scale)


def _tilt_torque(state: PooledState) -> Tensor:
    """Torque toward zero roll and the commanded pitch in the yaw frame [N m/kg], shape (N, 2)."""
    error = torch.stack((state.base_roll, state.base_pitch - state.command[:, 4]), dim=1)
    return (-_TILT_STIFFNESS * error).clamp(-_MAX_TILT_TORQUE, _MAX_TILT_TORQUE)


def _drag(state: PooledState) -> Tensor:
    """Force toward the commanded velocity in the yaw frame [N/kg], shape (N, 2)."""
    bound = _MAX_DRAG * _GRAVITY
    return (_DRAG * (state.command[:, :2] - state.base_lin_vel_b[:, :2])).clamp(-bound, bound)


def _support(state: PooledState, robots: PooledRobots) -> Tensor:
    """Force toward the commanded height, upwards only [N/kg], shape (N,)."""
    sag = robots.nominal_height + state.command[:, 3] - state.base_height
    return (_SUPPORT * _GRAVITY + _HEIGHT_STIFFNESS * sag).clamp(0.0, _MAX_SUPPORT * _GRAVITY)


def harness_wrench(state: PooledState, robots: PooledRobots, scale: Tensor) -> Tensor:
    """Help of the virtual harness: upright as commanded, carried by at most 0.6 of the weight, mildly dragged along.

    Args:
        state: state before the control step.
        robots: constants of each environment's robot.
        scale: strength in [0, 1], shape (N,).

    Returns:
        World-frame force [N] and torque [N m] on the base, shape (N, 6); exactly zero where the scale is.
    """
    support = _support(state, robots).unsqueeze(1)
    wrench = torch.cat((_drag(state), support, _tilt_torque(state), torch.zeros_like(support)), dim=1)
    wrench = from_yaw_frame(state.heading_w.unsqueeze(1), wrench.unflatten(1, (2, 3))).flatten(1)
    strength = (robots.total_mass * scale).unsqueeze(1)
    return torch.where(strength > 0.0, wrench * strength, 0.0)


def harness_damping(robots: PooledRobots, scale: Tensor) -> Tensor:
    """Damping of the bases' rotation by the harness [N m s/rad], shape (N,)."""
    return _TILT_DAMPING * robots.total_mass * scale
