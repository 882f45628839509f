"""Learning aids, annealed to exactly zero: a virtual harness on the base, and a softer gait reward (ours).

Both have one scale per robot that decays while the robot no longer needs it. Evaluation runs without either.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from eagle_rl.config.schema import AidsCfg

from ..geometry import rotate_yaw, yaw_of
from ..state import PooledRobots, PooledState

_SNAP = 0.01
"""Scale under which an aid is off [-]."""
_GRAVITY = 9.81

# The harness, per kilogram of robot; the first is 200 N m/rad for a robot of 33 kg.
_TILT_STIFFNESS = 200.0 / 33.0
"""[N m/rad/kg]"""
_TILT_DAMPING = 2.5 / 33.0
"""[N m s/rad/kg]; explicit over a control step of 0.02 s, so it must stay below I / dt: a pelvis held by the damping of
its joints acts like 0.1 kg m^2, which allows 5 N m s/rad at 33 kg."""
_MAX_TILT_TORQUE = 60.0 / 33.0
"""[N m/kg]"""
_MAX_DAMPING_TORQUE = 10.0 / 33.0
"""[N m/kg]"""
_HEIGHT_STIFFNESS = 50.0
"""[N/m/kg]: full support 0.1 m below the commanded height."""
_MAX_SUPPORT = 0.5
"""Share of the weight the harness carries at most [-]."""
_DRAG = 1.0
"""[N s/m/kg]"""
_MAX_DRAG = 0.15
"""Bound on the drag as a share of the weight [-]."""


class LearningAids:
    """Scales of both aids, one per robot."""

    def __init__(self, cfg: AidsCfg, num_robots: int, device: torch.device | str = "cpu") -> None:
        """Start both aids at their configured scales."""
        self.cfg = cfg
        self.harness = torch.full((num_robots,), cfg.harness, dtype=torch.float64, device=device)
        """Scale of the harness, shape (R,)."""
        self.gait_shaping = torch.full((num_robots,), cfg.gait_shaping, dtype=torch.float64, device=device)
        """Scale s of gait shaping, shape (R,)."""

    def update(self, episode_ratio: Tensor, contact_match: Tensor) -> None:
        """Decay what is no longer needed; call once per ``interval_steps``.

        Args:
            episode_ratio: mean episode length of each robot over the full length, shape (R,).
            contact_match: share of steps in which its feet agree with the clock, shape (R,).
        """
        cfg = self.cfg
        self.harness = _decayed(self.harness, episode_ratio >= cfg.min_episode_ratio, cfg.harness_decay)
        self.gait_shaping = _decayed(self.gait_shaping, contact_match >= cfg.min_contact_match, cfg.gait_shaping_decay)

    def state_dict(self) -> dict[str, Tensor]:
        """Both scales."""
        return {"harness": self.harness.clone(), "gait_shaping": self.gait_shaping.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.harness = state["harness"].to(self.harness)
        self.gait_shaping = state["gait_shaping"].to(self.gait_shaping)

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


def _bounded(x: Tensor, bound: Tensor) -> Tensor:
    return torch.maximum(torch.minimum(x, bound), -bound)


def _tilt_torque(state: PooledState, mass: Tensor) -> Tensor:
    """Torque toward zero roll and the commanded pitch in the yaw frame [N m], shape (N, 2)."""
    error = torch.stack((state.base_roll, state.base_pitch - state.command[:, 4]), dim=1)
    spring = _bounded(-_TILT_STIFFNESS * mass * error, _MAX_TILT_TORQUE * mass)
    damping = _bounded(-_TILT_DAMPING * mass * state.base_ang_vel_b[:, :2], _MAX_DAMPING_TORQUE * mass)
    return spring + damping


def _force(state: PooledState, robots: PooledRobots, mass: Tensor) -> Tensor:
    """Drag toward the commanded velocity and support toward the commanded height in the yaw frame [N], (N, 3)."""
    drag = _DRAG * mass * (state.command[:, :2] - state.base_lin_vel_b[:, :2])
    drag = _bounded(drag, _MAX_DRAG * _GRAVITY * mass)
    sag = (robots.nominal_height + state.command[:, 3] - state.base_height).unsqueeze(1)
    support = torch.minimum(_HEIGHT_STIFFNESS * mass * sag, _MAX_SUPPORT * _GRAVITY * mass).clamp(min=0.0)
    return torch.cat((drag, support), dim=1)


def harness_wrench(state: PooledState, robots: PooledRobots, scale: Tensor) -> Tensor:
    """Help of the virtual harness: upright as commanded, carried by at most half the weight, mildly dragged along.

    Args:
        state: state before the control step.
        robots: constants of each environment's robot.
        scale: strength in [0, 1], shape (N,).

    Returns:
        World-frame force [N] and torque [N m] on the base, shape (N, 6); exactly zero where the scale is.
    """
    mass = robots.total_mass.unsqueeze(1)
    tilt = _tilt_torque(state, mass)
    torque = torch.cat((tilt, torch.zeros_like(tilt[:, :1])), dim=1)
    yaw = yaw_of(state.root_quat_w).unsqueeze(1)
    wrench = rotate_yaw(yaw, torch.stack((_force(state, robots, mass), torque), dim=1)).flatten(1)
    scale = scale.to(wrench.dtype).unsqueeze(1)
    return torch.where(scale > 0.0, wrench * scale, 0.0)
