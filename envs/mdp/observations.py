"""What actor and critic see, computed once over the pool (paper, Sec. Embodiment-aware Observation; HugWBC 5).

Columns, units and scales are those of ``envs.mdp.layout``; this file only gathers quantities in that order.
"""

from __future__ import annotations

import torch
from torch import Tensor

from eagle_rl.config.schema import ObservationsCfg, Range

from ..geometry import into_yaw_frame
from ..state import PooledRobots, PooledState
from .gait import clock, clock_harmonics
from .layout import REFERENCE_MASS, SENSED_SIZE, ObservationLayout, scale_vector, scan_points

__all__ = [
    "History",
    "ObservationLayout",
    "clock_observation",
    "command_observation",
    "critic_observation",
    "delay",
    "estimation_target",
    "noise_scale",
    "proprioception",
    "scan_points",
]

COLLISION_FORCE = 2.0
"""Contact force above which a link counts as in collision [N] (HugWBC 5)."""


def _scaled(columns: list[Tensor], cfg: ObservationsCfg, group: str, first: int = 0) -> list[Tensor]:
    """Scale and bound columns; the first is column ``first`` of its group.

    They are laid side by side afterwards: a kernel writes what is laid side by side before it goes on with it.
    """
    widths = [x.shape[1] for x in columns]
    scale = scale_vector(cfg, group, columns[0].dtype, columns[0].device)[first : first + sum(widths)]
    return [(x * s).clamp_(-cfg.clip, cfg.clip) for x, s in zip(columns, scale.split(widths), strict=True)]


def proprioception(state: PooledState, robots: PooledRobots, cfg: ObservationsCfg) -> Tensor:
    """One clean, scaled frame o^prio: angular velocity, gravity, joint positions and velocities, last action.

    Returns:
        Shape (N, F), F = 102 with the last action, else 70; zero in absent slots.
    """
    joint_pos_rel = (state.joint_pos - robots.default_joint_pos) * robots.slot_mask
    columns = [state.base_ang_vel_b, state.projected_gravity_b, joint_pos_rel, state.joint_vel]
    return torch.cat(_scaled([*columns, state.actions] if cfg.last_action else columns, cfg, "history"), dim=1)


def noise_scale(cfg: ObservationsCfg, robots: PooledRobots) -> Tensor:
    """Half widths of the uniform noise on a scaled frame, shape (N, F); zero in absent slots and on actions."""
    noise, mask = cfg.noise, robots.slot_mask
    three = mask.new_ones(mask.shape[0], 3)
    columns = [
        noise.base_ang_vel * three,
        noise.projected_gravity * three,
        noise.joint_pos * mask,
        noise.joint_vel * mask,
    ]
    if cfg.last_action:
        columns.append(torch.zeros_like(mask))
    frame = torch.cat(columns, dim=1) * float(cfg.enable_corruption)
    return frame * scale_vector(cfg, "history", frame.dtype, frame.device)[: frame.shape[1]]


def delay(current: Tensor, previous: Tensor, fraction: Tensor) -> Tensor:
    """What sensors that lag by a fraction of the control step say (HugWBC 8).

    Args:
        current: newest frame, shape (N, F).
        previous: the clean frame one step before, shape (N, F).
        fraction: latency over control step, in [0, 1], shape (N, 1).

    Returns:
        The blend of both in the sensed columns, shape (N, ``SENSED_SIZE``).
    """
    return torch.lerp(current[:, :SENSED_SIZE], previous[:, :SENSED_SIZE], fraction)


class History:
    """The last K frames s_t, newest first."""

    def __init__(self, num_envs: int, length: int, frame: Tensor) -> None:
        """Start with zeros, K frames as wide as ``frame``, shape (..., F); call :meth:`reset` before use."""
        self._length = length
        self.flat = frame.new_zeros(num_envs, length * frame.shape[-1])
        """The observation group "history", shape (N, K * F)."""

    def push(self, *columns: Tensor) -> None:
        """Put a frame in front and drop the oldest; tensors handed out before keep their values.

        Args:
            columns: the frame's, side by side F of them, shape (N, ...) each.
        """
        width = self.flat.shape[1] // self._length
        self.flat = torch.cat((*columns, self.flat[:, :-width]), dim=1)

    def reset(self, ids: Tensor, frame: Tensor) -> None:
        """Fill all K frames of some environments with their first frame, shapes (n,) and (n, F) (HugWBC 5)."""
        self.flat[ids] = frame.repeat(1, self._length)


def command_observation(state: PooledState, cfg: ObservationsCfg) -> Tensor:
    """Scaled command c_t, shape (N, 5)."""
    (command,) = _scaled([state.command], cfg, "command")
    return command


def clock_observation(state: PooledState, cfg: ObservationsCfg) -> Tensor:
    """Gait clock, shape (N, 2), or with harmonics (N, 4 ``clock_harmonics``)."""
    sines = clock(state.foot_phase)
    if not cfg.clock_harmonics:
        return sines
    return torch.cat((sines, clock_harmonics(state.foot_phase, cfg.clock_harmonics)), dim=1)


def _friction_column(friction: Tensor, friction_range: Range) -> Tensor:
    """Friction mapped from its range to [-1, 1], shape (N, 1); zero where the range is one number."""
    low, high = friction_range
    if high <= low:
        return torch.zeros_like(friction).unsqueeze(1)
    return ((friction - low) * (2.0 / (high - low)) - 1.0).unsqueeze(1)


def _privileged_columns(state: PooledState, robots: PooledRobots, friction_range: Range) -> list[Tensor]:
    height = state.base_height - robots.nominal_height
    forces = into_yaw_frame(state.heading_w.unsqueeze(1), state.foot_force_w).flatten(1)
    scan = height.unsqueeze(1) - state.height_scan
    return [
        state.base_lin_vel_b,
        (height - state.command[:, 3]).clamp(-0.5, 0.5).unsqueeze(1),
        state.foot_height.clamp(-1.0, 1.0),
        forces * (REFERENCE_MASS / robots.total_mass).unsqueeze(1),
        (torch.linalg.vector_norm(state.link_force_w, dim=2) > COLLISION_FORCE).to(scan.dtype),
        _friction_column(state.friction, friction_range),
        scan.clamp(-1.0, 1.0),
    ]


def critic_observation(
    frame: Tensor,
    state: PooledState,
    robots: PooledRobots,
    embodiment: Tensor | None,
    cfg: ObservationsCfg,
    friction_range: Range,
) -> Tensor:
    """What the critic sees, never corrupted: frame, command, clock and everything privileged (paper; HugWBC 5).

    Args:
        frame: clean :func:`proprioception` of the state, shape (N, F).
        state: state after the step.
        robots: constants of each environment's robot.
        embodiment: standardised o_ea, shape (N, E), or None where it is off.
        cfg: scales and bound.
        friction_range: range of ``RandomizationCfg.friction``.

    Returns:
        Shape (N, C), columns as in ``ObservationLayout.groups["critic"]``.
    """
    columns = [state.command, clock(state.foot_phase), *_privileged_columns(state, robots, friction_range)]
    columns = columns if embodiment is None else [*columns, embodiment]
    if cfg.clock_harmonics:
        columns.append(clock_harmonics(state.foot_phase, cfg.clock_harmonics))
    return torch.cat((frame, *_scaled(columns, cfg, "critic", first=frame.shape[1])), dim=1)


def estimation_target(state: PooledState, embodiment: Tensor | None, cfg: ObservationsCfg) -> Tensor:
    """What the actor's estimator is to recover: scaled base velocity and o_ea, shape (N, 3 + E)."""
    columns = [state.base_lin_vel_b]
    return torch.cat(_scaled(columns if embodiment is None else [*columns, embodiment], cfg, "estimate"), dim=1)
