"""Numbers to read ours against: floors of robots that ignore their command, and the paper's own tables.

Transcribed from the paper's Tab. "Command-tracking errors" and Tab. "Unitree H1 command-tracking errors"; each tuple is
(E_vx [m/s], E_vy [m/s], E_omega [rad/s], E_h [m], E_p [rad]).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from eagle_rl.config.schema import CommandsCfg, EvaluationCfg, Range
from eagle_rl.evaluation.protocol import NUM_VELOCITIES, finishing_ranges, num_draws

Errors = tuple[float, float, float, float, float]


def _mean_size(bounds: Range) -> float:
    """Mean |c| of a command that is uniform within bounds."""
    low, high = bounds
    return abs(low) if low == high else (high * abs(high) - low * abs(low)) / (2.0 * (high - low))


def _mean_deviation(bounds: Range) -> float:
    """Mean distance of such a command from the middle of its range."""
    return (bounds[1] - bounds[0]) / 4.0


def floors(ev: EvaluationCfg, ranges: Sequence[Range]) -> dict[str, tuple[float, ...]]:
    """What robots that ignore their command score in a protocol, with commands from these ranges.

    One stands still, upright, at its nominal height; the other does what is best of what does not depend on the
    command: the middle of every range. Where half of the draws have no velocity, the best constant velocity is zero
    too; so is the best constant posture where postures stay at zero.
    """
    errors = {"stand still": [*map(_mean_size, ranges)], "best constant": [*map(_mean_deviation, ranges)]}
    velocities, postures = slice(NUM_VELOCITIES), slice(NUM_VELOCITIES, None)
    if ev.protocol == "standing":
        walking = 0.5 if num_draws(ev) > 1 else 0.0
        shared = [walking * error for error in errors["stand still"][velocities]]
        errors = {name: [*shared, *own[postures]] for name, own in errors.items()}
    if ev.protocol == "upright":
        errors = {name: [*own[velocities], *(0.0 for _ in own[postures])] for name, own in errors.items()}
    return {name: tuple(own) for name, own in errors.items()}


def score_units(ev: EvaluationCfg, ranges: Sequence[Range]) -> tuple[float, ...]:
    """Errors that count as 1 in a score: those of standing still, or, of a command that is always zero, the usual."""
    usual = map(_mean_size, finishing_ranges(CommandsCfg()))
    return tuple(floor or size for floor, size in zip(floors(ev, ranges)["stand still"], usual, strict=True))


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
