"""The left/right mirror of a pooled state: the robot seen in a mirror that stands in the world's x-z plane."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from eagle_rl.config.schema import ObservationsCfg

from ..state import PooledRobots, PooledState
from .layout import AXIAL, COMMAND, FEET, LINKS, POLAR, SLOTS, Mirror, scan_mirror

_QUATERNION = Mirror.keep(1.0, -1.0, 1.0, -1.0)


def _mirrored(x: Tensor, mirror: Mirror) -> Tensor:
    """Mirror the last dimension."""
    return x[..., list(mirror.perm)] * x.new_tensor(mirror.sign)


def _foot_vectors(x: Tensor) -> Tensor:
    return _mirrored(x.flip(1), POLAR)


def mirror_state(state: PooledState, cfg: ObservationsCfg) -> PooledState:
    """The mirrored state; mirroring twice gives the state back.

    Args:
        state: any pooled state.
        cfg: grid of the height scan.

    Returns:
        Left and right limbs, feet, links, scan points and phases swapped; y of polar vectors, x and z of axial ones,
        v_y and omega flipped.
    """
    slots = {name: _mirrored(getattr(state, name), SLOTS) for name in _SLOT_FIELDS}
    polar = {name: _mirrored(getattr(state, name), POLAR) for name in _POLAR_FIELDS}
    feet = {name: _foot_vectors(getattr(state, name)) for name in _FOOT_VECTOR_FIELDS}
    return replace(
        state,
        **slots,
        **polar,
        **feet,
        root_quat_w=_mirrored(state.root_quat_w, _QUATERNION),
        base_ang_vel_b=_mirrored(state.base_ang_vel_b, AXIAL),
        foot_height=_mirrored(state.foot_height, FEET),
        last_foot_contact=state.last_foot_contact.flip(1),
        link_force_w=_mirrored(state.link_force_w[:, list(LINKS.perm)], POLAR),
        height_scan=_mirrored(state.height_scan, scan_mirror(cfg)),
        command=_mirrored(state.command, COMMAND),
        foot_phase=_mirrored(state.foot_phase, FEET),
    )


_SLOT_FIELDS = (
    "joint_pos",
    "joint_vel",
    "joint_acc",
    "joint_torque",
    "actions",
    "last_actions",
    "last_last_actions",
)
_POLAR_FIELDS = ("root_pos_w", "base_lin_vel_b", "projected_gravity_b")
_FOOT_VECTOR_FIELDS = ("foot_pos_w", "foot_vel_w", "foot_force_w")


def mirror_robots(robots: PooledRobots) -> PooledRobots:
    """Constants of the mirrored robot; limits of joints that change sign change places. Symmetric robots stay equal."""
    lower, upper = (_mirrored(x, SLOTS) for x in (robots.joint_soft_lower, robots.joint_soft_upper))
    return replace(
        robots,
        slot_mask=_mirrored(robots.slot_mask, SLOTS).abs(),
        default_joint_pos=_mirrored(robots.default_joint_pos, SLOTS),
        joint_soft_lower=lower.minimum(upper),
        joint_soft_upper=lower.maximum(upper),
        action_scale=_mirrored(robots.action_scale, SLOTS).abs(),
    )
