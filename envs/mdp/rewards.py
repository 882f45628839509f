"""Reward terms: the paper's table row by row, the three it inherits without printing them, and one of ours.

Every term is a pure function of one control step and returns the unweighted value, shape (N,). Terms that measure an
error are positive and have a negative weight in ``RewardWeightsCfg``. ``compute_rewards`` weights and sums them.
Feet j are (left, right); ``rho_kappa(x) = exp(-x / kappa)`` is applied to squared norms, so kappa has squared units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from eagle_rl.config.schema import GaitCfg, RewardsCfg, RewardWeightsCfg

from ..robots.slots import HIP_DEVIATION_SLOTS, UPPER_SLOTS
from ..state import PooledRobots, PooledState
from . import gait
from .layout import REFERENCE_MASS

SHAPING_KAPPA = 1e4
"""Widening of the contact-force kernel at full gait shaping for a robot of 33 kg [N^2], growing with the square of the
weight: 50 saturates at 20 N, where nothing is learned."""
SHAPING_WEIGHT = 2.0
"""Growth of the gait weights at full gait shaping [-]."""

_HIP = slice(HIP_DEVIATION_SLOTS[0], HIP_DEVIATION_SLOTS[-1] + 1)
_UPPER = slice(UPPER_SLOTS[0], UPPER_SLOTS[-1] + 1)


@dataclass(frozen=True, kw_only=True)
class RewardContext:
    """What the terms need besides the state of ONE control step; build a new one each step."""

    cfg: RewardsCfg
    gait: GaitCfg
    gait_shaping: Tensor
    """Learning aid s, 0 for the paper's kernel, shape (N,)."""
    terminated: Tensor
    """Whether the episode ended by anything but its time limit, bool, shape (N,)."""
    _cache: dict[TermFunction, Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)

    def once(self, function: TermFunction, state: PooledState, robots: PooledRobots) -> Tensor:
        """Value of a term, or of a part that several terms share, computed at its first use."""
        if function not in self._cache:
            self._cache[function] = function(state, robots, self)
        return self._cache[function]


TermFunction = Callable[[PooledState, PooledRobots, RewardContext], Tensor]


def _rho(squared_error: Tensor, kappa: float | Tensor) -> Tensor:
    return torch.exp(squared_error / -kappa)


def _dot(x: Tensor, y: Tensor) -> Tensor:
    """Sum of products over the last dimension."""
    return torch.linalg.vecdot(x, y)


def _square_sum(x: Tensor) -> Tensor:
    return _dot(x, x)


def _tracking(squared_error: Tensor, state: PooledState, cfg: RewardsCfg) -> Tensor:
    """Mean of ``rho`` of a velocity's error and of a narrower ``rho``, one for standing, one for walking (schema)."""
    wide = _rho(squared_error, cfg.tracking_kappa)
    if cfg.standing_kappa == cfg.walking_kappa == cfg.tracking_kappa:
        return wide
    kappa = torch.where(state.standing, cfg.standing_kappa, cfg.walking_kappa).to(squared_error.dtype)
    return 0.5 * (wide + _rho(squared_error, kappa))


def _lin_vel_error(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``|v_xy* - v_xy|^2`` in the base frame [m^2/s^2]."""
    return _square_sum(state.command[:, :2] - state.base_lin_vel_b[:, :2])


def _ang_vel_error(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``(omega_z* - omega_z)^2`` in the base frame [rad^2/s^2]."""
    return (state.command[:, 2] - state.base_ang_vel_b[:, 2]).square()


def lin_vel_tracking(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``rho(|v_xy* - v_xy|^2)`` in the base frame [-], a reward (Lin. vel. tracking)."""
    return _tracking(ctx.once(_lin_vel_error, state, robots), state, ctx.cfg)


def ang_vel_tracking(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``rho((omega_z* - omega_z)^2)`` in the base frame [-], a reward (Ang. vel. tracking)."""
    return _tracking(ctx.once(_ang_vel_error, state, robots), state, ctx.cfg)


def base_height(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``(h_0 + h* - h)^2`` with each robot's nominal height h_0 [m^2], an error (Base height)."""
    return (robots.nominal_height + state.command[:, 3] - state.base_height).square()


def body_pitch(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``(p* - p)^2`` [rad^2], an error (Body pitch)."""
    return (state.command[:, 4] - state.base_pitch).square()


def _contact_probability(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """C(phi) of both feet, shape (N, 2)."""
    return gait.contact_probability(state.foot_phase, ctx.gait)


def _foot_speed(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """Squared horizontal speed of both feet [m^2/s^2], shape (N, 2)."""
    return _square_sum(state.foot_vel_w[..., :2])


def foot_swing(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``sum_j (1 - C_j) (l_target,j - l_foot,j)^2``, vertical, clipped [m^2], an error (Foot-swing position)."""
    target = gait.swing_target(state.foot_phase, robots.swing_height, ctx.gait)
    swing = 1.0 - ctx.once(_contact_probability, state, robots)
    return _dot(swing, (target - state.foot_height).square()).clamp(max=ctx.cfg.foot_swing_clip)


def contact_vel(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``sum_j C_j (1 - rho(|v_xy,j|^2))``: a foot in stance should not move [-], an error (Contact vel.)."""
    moving = 1.0 - _rho(ctx.once(_foot_speed, state, robots), ctx.cfg.contact_vel_kappa)
    return _dot(ctx.once(_contact_probability, state, robots), moving)


def contact_force(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``sum_j (1 - C_j) (1 - rho(|f_j|^2))``: a foot in swing should carry nothing [-], an error (Contact force).

    The norm is over all three components, else a vertically loaded swing foot goes unpunished (HugWBC 11.2).
    """
    kappa = (
        ctx.cfg.contact_force_kappa + SHAPING_KAPPA * ctx.gait_shaping * (robots.total_mass / REFERENCE_MASS).square()
    )
    return _swing_load(state, robots, ctx, kappa.unsqueeze(1))


def _swing_load(state: PooledState, robots: PooledRobots, ctx: RewardContext, kappa: float | Tensor) -> Tensor:
    loaded = 1.0 - _rho(_square_sum(state.foot_force_w), kappa)
    return _dot(1.0 - ctx.once(_contact_probability, state, robots), loaded)


def roll_pitch_rate(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``|omega_xy|^2`` in the base frame [rad^2/s^2], an error (Roll-pitch Ang. vel.)."""
    return _square_sum(state.base_ang_vel_b[:, :2])


def vertical_speed(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``v_z^2`` in the base frame [m^2/s^2], an error (Vertical speed)."""
    return state.base_lin_vel_b[:, 2].square()


def foot_slip(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``sum_j contact_j (1 - rho(|v_xy,j|^2))``, contact now or one step ago [-], an error (Foot slip).

    The printed form has no contact gate and would slow down swing feet (HugWBC 11.3).
    """
    contact = (state.foot_contact | state.last_foot_contact).to(state.foot_vel_w.dtype)
    return _dot(contact, 1.0 - _rho(ctx.once(_foot_speed, state, robots), ctx.cfg.foot_slip_kappa))


def landing(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``sum_j air_j down_j exp(-l_j / l_0) |v_j|^2``: a foot that comes down should stop first [m^2/s^2], an error.

    Over feet without contact that move down, at the height l_j of their soles (ours; docs/experiments.md, 23).
    """
    coming_down = ~state.foot_contact & (state.foot_vel_w[..., 2] < 0)
    near = torch.exp(state.foot_height.clamp(min=0.0) / -ctx.cfg.landing_height)
    return _dot(near * coming_down, _square_sum(state.foot_vel_w))


def action_rate(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``|a_t - a_(t-1)|^2`` [-], an error (Action rate)."""
    return _square_sum((state.actions - state.last_actions) * robots.slot_mask)


def action_smoothness(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``|a_t - 2 a_(t-1) + a_(t-2)|^2`` [-], an error (Action smoothness)."""
    bend = torch.add(state.actions + state.last_last_actions, state.last_actions, alpha=-2.0)
    return _square_sum(bend * robots.slot_mask)


def joint_torque(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``|tau|^2`` of the last physics step [N^2 m^2], an error (Joint torque)."""
    return _square_sum(state.joint_torque * robots.slot_mask)


def joint_acceleration(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``|qdd|^2`` [rad^2/s^4], an error (Joint acceleration)."""
    return _square_sum(state.joint_acc * robots.slot_mask)


def _deviation(state: PooledState, robots: PooledRobots, slots: slice) -> Tensor:
    deviation = state.joint_pos[:, slots] - robots.default_joint_pos[:, slots]
    return _square_sum(deviation * robots.slot_mask[:, slots])


def upper_deviation(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``|q_default - q|^2`` over waist, head and arms [rad^2], an error (Upper-joint deviation)."""
    return _deviation(state, robots, _UPPER)


def hip_deviation(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``|q_default - q|^2`` over hip roll and hip yaw [rad^2], an error (Hip-joint deviation)."""
    return _deviation(state, robots, _HIP)


def base_orientation(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """``|g_xy|^2`` or, with ``orientation: commanded``, ``|g_xy - (sin p*, 0)|^2`` [-], an error (Base Orientation)."""
    gravity_x, gravity_y = state.projected_gravity_b[:, 0], state.projected_gravity_b[:, 1]
    if ctx.cfg.orientation == "commanded":
        gravity_x = gravity_x - torch.sin(state.command[:, 4])
    return gravity_x.square() + gravity_y.square()


def termination(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """1 in the step in which the robot falls [-], an error (inherited, HugWBC 4)."""
    return ctx.terminated.to(state.base_height.dtype)


def alive(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """1 in every step [-], a reward (inherited, HugWBC 4)."""
    return torch.ones_like(state.base_height)


def joint_limits(state: PooledState, robots: PooledRobots, ctx: RewardContext) -> Tensor:
    """Angle beyond the soft limits, summed over joints [rad], an error (inherited, HugWBC 4)."""
    inside = torch.clamp(state.joint_pos, robots.joint_soft_lower, robots.joint_soft_upper)
    return _dot((state.joint_pos - inside).abs(), robots.slot_mask)


class RewardTerm(NamedTuple):
    """A term and the scales that act on it besides its weight."""

    function: TermFunction
    curriculum: bool = False
    """Whether the penalty scale k multiplies it (rows marked (k), HugWBC 4)."""
    shaped: bool = False
    """Whether gait shaping raises its weight."""


REWARD_TERMS: dict[str, RewardTerm] = {
    "lin_vel_tracking": RewardTerm(lin_vel_tracking),
    "ang_vel_tracking": RewardTerm(ang_vel_tracking),
    "base_height": RewardTerm(base_height, curriculum=True),
    "body_pitch": RewardTerm(body_pitch, curriculum=True),
    "foot_swing": RewardTerm(foot_swing, shaped=True),
    "contact_vel": RewardTerm(contact_vel, shaped=True),
    "contact_force": RewardTerm(contact_force, shaped=True),
    "roll_pitch_rate": RewardTerm(roll_pitch_rate, curriculum=True),
    "vertical_speed": RewardTerm(vertical_speed, curriculum=True),
    "foot_slip": RewardTerm(foot_slip),
    "action_rate": RewardTerm(action_rate, curriculum=True),
    "action_smoothness": RewardTerm(action_smoothness, curriculum=True),
    "joint_torque": RewardTerm(joint_torque, curriculum=True),
    "joint_acceleration": RewardTerm(joint_acceleration, curriculum=True),
    "upper_deviation": RewardTerm(upper_deviation),
    "hip_deviation": RewardTerm(hip_deviation),
    "base_orientation": RewardTerm(base_orientation, curriculum=True),
    "termination": RewardTerm(termination),
    "alive": RewardTerm(alive),
    "joint_limits": RewardTerm(joint_limits),
    "landing": RewardTerm(landing),
}
"""Every term by its name in ``RewardWeightsCfg``."""


def compute_rewards(
    state: PooledState, robots: PooledRobots, ctx: RewardContext, factors: Tensor
) -> tuple[Tensor, dict[str, Tensor]]:
    """Weighted reward of one control step, ``sum(weight * dt * term)`` (HugWBC 0.1).

    Args:
        state: state after the step.
        robots: constants of each environment's robot.
        ctx: configuration and learning aids of this step.
        factors: weight * dt of each term of non-zero weight, see :func:`reward_factors`.

    Returns:
        The reward, shape (N,), and its weighted terms by name, each (N,); terms of zero weight are absent.
    """
    shaped_weight = 1.0 + SHAPING_WEIGHT * ctx.gait_shaping
    values: dict[str, Tensor] = {}
    for name in terms_in_use(ctx.cfg.weights):
        term = REWARD_TERMS[name]
        value = ctx.once(term.function, state, robots)
        values[name] = value * shaped_weight if term.shaped else value
    if not values:
        return torch.zeros_like(state.base_height), {}
    unweighted = torch.stack(list(values.values()))
    weighted = unweighted * factors
    return weighted.sum(dim=0), dict(zip(values, weighted.unbind(), strict=True))


def terms_in_use(weights: RewardWeightsCfg) -> tuple[str, ...]:
    """Names of the terms whose weight is not zero, in the order of ``REWARD_TERMS``."""
    return tuple(name for name in REWARD_TERMS if getattr(weights, name) != 0.0)


def reward_factors(weights: RewardWeightsCfg, penalty_scale: float, step_dt: float, like: Tensor) -> Tensor:
    """Factor on each of :func:`terms_in_use`, shape (T, 1).

    Args:
        weights: of the terms.
        penalty_scale: k, factor on the terms of the penalty curriculum [-].
        step_dt: control step [s].
        like: tensor of the dtype and on the device that are wanted.
    """
    return _factors(weights, penalty_scale, step_dt, like.dtype, like.device)


@lru_cache(maxsize=4)
def _factors(
    weights: RewardWeightsCfg, penalty_scale: float, step_dt: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """See :func:`reward_factors`."""
    factors = [
        [getattr(weights, name) * step_dt * (penalty_scale if REWARD_TERMS[name].curriculum else 1.0)]
        for name in terms_in_use(weights)
    ]
    return torch.tensor(factors, dtype=dtype, device=device)


def success_scores(
    state: PooledState, robots: PooledRobots, ctx: RewardContext
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The four quantities that judge a command window, each 1 at best, shape (N,) (HugWBC 2).

    Linear and angular velocity tracking, then 1 minus the mean over the feet of contact force and contact velocity
    errors; all by the table's kernels, whatever the gait shaping or narrower kernels.
    """
    return (
        _rho(ctx.once(_lin_vel_error, state, robots), ctx.cfg.tracking_kappa),
        _rho(ctx.once(_ang_vel_error, state, robots), ctx.cfg.tracking_kappa),
        1.0 - 0.5 * _swing_load(state, robots, ctx, ctx.cfg.contact_force_kappa),
        1.0 - 0.5 * ctx.once(contact_vel, state, robots),
    )
