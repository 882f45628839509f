"""Numbers to read ours against: floors of robots that ignore their command, and the paper's own tables.

Transcribed from the paper's Tab. "Command-tracking errors" and Tab. "Unitree H1 command-tracking errors"; each tuple is
(E_vx [m/s], E_vy [m/s], E_omega [rad/s], E_h [m], E_p [rad]).
"""

from __future__ import annotations

from collections.abc import Mapping

from eagle_rl.config.schema import EvaluationCfg
from eagle_rl.evaluation.protocol import num_draws

Errors = tuple[float, float, float, float, float]

STAND_STILL: Errors = (0.50, 0.20, 0.50, 0.15, 0.2125)
"""Mean |c_d| on the finishing ranges: the errors of a robot that stands still, upright, at its nominal height."""

BEST_CONSTANT: Errors = (0.45, 0.20, 0.50, 0.075, 0.20)
"""Errors of the best behaviour that does not depend on the command: the middle of every range."""


def floors(ev: EvaluationCfg) -> dict[str, Errors]:
    """What robots that ignore their command score in a protocol.

    Where half of the draws have no velocity, the best constant velocity is zero too; so is the best constant posture
    where postures stay at zero.
    """
    constant = {"stand still": STAND_STILL, "best constant": BEST_CONSTANT}
    if ev.protocol == "upright":
        return {name: (v_x, v_y, omega, 0.0, 0.0) for name, (v_x, v_y, omega, _, _) in constant.items()}
    if ev.protocol != "standing":
        return constant
    walking = 0.5 if num_draws(ev) > 1 else 0.0
    v_x, v_y, omega = (walking * error for error in STAND_STILL[:3])
    return {
        "stand still": (v_x, v_y, omega, *STAND_STILL[3:]),
        "best constant": (v_x, v_y, omega, *BEST_CONSTANT[3:]),
    }


PAPER: Mapping[str, Mapping[str, Errors]] = {
    "PPO": {
        "h1": (0.108, 0.129, 0.114, 0.075, 0.182),
        "g1": (0.092, 0.127, 0.121, 0.051, 0.164),
        "adam": (0.328, 0.107, 0.235, 0.051, 0.204),
        "n1": (0.124, 0.141, 0.107, 0.073, 0.165),
        "t1": (0.147, 0.203, 0.105, 0.047, 0.156),
    },
    "PPO w/o EO": {
        "h1": (0.290, 0.161, 0.152, 0.078, 0.189),
        "g1": (0.104, 0.113, 0.095, 0.052, 0.165),
        "adam": (0.375, 0.158, 0.310, 0.063, 0.218),
        "n1": (0.126, 0.144, 0.076, 0.079, 0.162),
        "t1": (0.140, 0.194, 0.104, 0.046, 0.151),
    },
    "COMPASS": {
        "h1": (0.725, 0.390, 0.476, 0.085, 0.273),
        "g1": (0.171, 0.119, 0.124, 0.035, 0.169),
        "adam": (0.763, 0.371, 0.339, 0.045, 0.233),
        "n1": (0.060, 0.117, 0.137, 0.056, 0.160),
        "t1": (0.831, 0.307, 0.179, 0.044, 0.151),
    },
    "Kickstarting": {
        "h1": (0.323, 0.141, 0.122, 0.075, 0.182),
        "g1": (0.117, 0.118, 0.075, 0.050, 0.167),
        "adam": (0.399, 0.086, 0.141, 0.041, 0.192),
        "n1": (0.147, 0.142, 0.130, 0.077, 0.168),
        "t1": (0.761, 0.190, 0.100, 0.047, 0.149),
    },
    "EAGLE": {
        "h1": (0.061, 0.117, 0.054, 0.076, 0.169),
        "g1": (0.066, 0.105, 0.077, 0.049, 0.164),
        "adam": (0.182, 0.084, 0.115, 0.050, 0.196),
        "n1": (0.068, 0.126, 0.058, 0.074, 0.157),
        "t1": (0.109, 0.187, 0.045, 0.045, 0.152),
    },
    "EAGLE w/ ID": {
        "h1": (0.051, 0.110, 0.054, 0.082, 0.186),
        "g1": (0.067, 0.095, 0.071, 0.047, 0.176),
        "adam": (0.156, 0.101, 0.117, 0.056, 0.197),
        "n1": (0.056, 0.135, 0.056, 0.074, 0.168),
        "t1": (0.090, 0.187, 0.041, 0.044, 0.159),
    },
}
"""The paper's main table by method, then robot."""

PAPER_H1: Mapping[str, Mapping[str, Errors]] = {
    "single-robot PPO": {"h1": (0.067, 0.101, 0.052, 0.072, 0.181)},
    "EAGLE-generalist": {"h1": (0.061, 0.117, 0.054, 0.076, 0.169)},
    "EAGLE-specialist": {"h1": (0.048, 0.105, 0.042, 0.072, 0.174)},
}
"""The paper's Unitree H1 table."""
