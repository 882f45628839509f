"""The table of observations: every term's columns, unit, scale and left/right mirror.

Observation functions, the mirror maps of the learner and the printed description of the task all read this one table.
Mirroring reflects the robot in its x-z plane: polar vectors (velocity, gravity, force) flip y, axial ones (angular
velocity) flip x and z, left and right swap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from eagle_rl.config.schema import ObservationsCfg
from eagle_rl.errors import ConfigError

from ..robots.slots import MIRROR_PERMUTATION, MIRROR_SIGN, NUM_SLOTS
from ..robots.spec import COLLISION_LINKS
from ..robots.structure import structure_mirror

REFERENCE_MASS = 33.0
"""Robot mass at which ``ObservationScalesCfg.foot_force`` applies as it is [kg]."""


@dataclass(frozen=True)
class Mirror:
    """Mirrored column i is ``sign[i] * column[perm[i]]``."""

    perm: tuple[int, ...]
    sign: tuple[float, ...]

    @staticmethod
    def stack(mirrors: list[Mirror]) -> Mirror:
        """Mirror of columns laid side by side."""
        perm: list[int] = []
        for mirror in mirrors:
            start = len(perm)
            perm.extend(start + i for i in mirror.perm)
        return Mirror(tuple(perm), tuple(s for mirror in mirrors for s in mirror.sign))

    @staticmethod
    def swap(size: int, sign: tuple[float, ...] | None = None) -> Mirror:
        """Two blocks of ``size`` columns, left then right, change places; each keeps the signs of one block."""
        sign = sign or (1.0,) * size
        return Mirror((*range(size, 2 * size), *range(size)), sign + sign)

    @staticmethod
    def keep(*sign: float) -> Mirror:
        """Columns stay, with these signs."""
        return Mirror(tuple(range(len(sign))), sign)


POLAR = Mirror.keep(1.0, -1.0, 1.0)
AXIAL = Mirror.keep(-1.0, 1.0, -1.0)
COMMAND = Mirror.keep(1.0, -1.0, -1.0, 1.0, 1.0)
SLOTS = Mirror(tuple(MIRROR_PERMUTATION.tolist()), tuple(MIRROR_SIGN.tolist()))
FEET = Mirror.swap(1)
FOOT_VECTORS = Mirror.swap(3, POLAR.sign)


def _mirrored_link(link: str) -> str:
    if link.startswith("left_"):
        return "right_" + link.removeprefix("left_")
    return "left_" + link.removeprefix("right_") if link.startswith("right_") else link


LINKS = Mirror(tuple(COLLISION_LINKS.index(_mirrored_link(n)) for n in COLLISION_LINKS), (1.0,) * len(COLLISION_LINKS))

_BODY_SIGN = (1.0, *POLAR.sign, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0)
_BODIES = Mirror.stack([Mirror.keep(*_BODY_SIGN), Mirror.swap(len(_BODY_SIGN), _BODY_SIGN)])
EMBODIMENT = {"paper": _BODIES, "extended": Mirror.stack([_BODIES, Mirror(*structure_mirror())])}
"""o_ea by descriptor: torso, left and right foot, each mass, CoM, inertia (xx, yy, zz, xy, xz, yz). CoM y and the
products of inertia xy and yz flip, the feet change places."""


@dataclass(frozen=True)
class ObservationTerm:
    """Adjacent columns of one observation; the columns hold ``scale`` times the quantity in ``unit``."""

    name: str
    unit: str
    scale: float | tuple[float, ...]
    mirror: Mirror

    @property
    def size(self) -> int:
        """Number of columns."""
        return len(self.mirror.perm)

    @property
    def scales(self) -> tuple[float, ...]:
        """Scale of each column."""
        return self.scale if isinstance(self.scale, tuple) else (self.scale,) * self.size


def _axis(points: tuple[float, float, int]) -> Tensor:
    return torch.linspace(points[0], points[1], points[2], dtype=torch.float64)


def scan_points(cfg: ObservationsCfg) -> Tensor:
    """Points of the height scan in the base's yaw frame [m], float64, shape (P, 2): x outer, y inner."""
    return torch.cartesian_prod(_axis(cfg.scan_x), _axis(cfg.scan_y))


def scan_mirror(cfg: ObservationsCfg) -> Mirror:
    """Points at +y and -y change places."""
    first, last, num_y = cfg.scan_y
    if abs(first + last) > 1e-9:
        raise ConfigError(
            f"task.observations.scan_y: got first {first} and last {last}, expected -first == last, because the "
            f"left/right mirror must map the scan onto itself. Use for example ({-abs(last)}, {abs(last)}, {num_y})."
        )
    num_x = cfg.scan_x[2]
    perm = tuple(i * num_y + (num_y - 1 - j) for i in range(num_x) for j in range(num_y))
    return Mirror(perm, (1.0,) * len(perm))


def _frame_terms(cfg: ObservationsCfg) -> tuple[ObservationTerm, ...]:
    scales = cfg.scales
    terms = (
        ObservationTerm("base_ang_vel", "rad/s", scales.base_ang_vel, AXIAL),
        ObservationTerm("projected_gravity", "-", scales.projected_gravity, POLAR),
        ObservationTerm("joint_pos_rel", "rad", scales.joint_pos, SLOTS),
        ObservationTerm("joint_vel", "rad/s", scales.joint_vel, SLOTS),
    )
    return (*terms, ObservationTerm("last_action", "-", scales.last_action, SLOTS)) if cfg.last_action else terms


def _embodiment_terms(cfg: ObservationsCfg) -> tuple[ObservationTerm, ...]:
    if not cfg.embodiment_observation:
        return ()
    return (ObservationTerm("embodiment", "standardised", 1.0, EMBODIMENT[cfg.descriptor]),)


def _wave_terms(cfg: ObservationsCfg) -> tuple[ObservationTerm, ...]:
    """Last in their groups, so that a network that has not seen them grows at its end."""
    if not cfg.clock_harmonics:
        return ()
    mirror = Mirror.stack([FEET] * (2 * cfg.clock_harmonics - 1))
    return (ObservationTerm("clock_harmonics", "-", 1.0, mirror),)


def _tables(cfg: ObservationsCfg) -> dict[str, tuple[ObservationTerm, ...]]:
    scales = cfg.scales
    frame = _frame_terms(cfg)
    command = ObservationTerm("command", "m/s m/s rad/s m rad", scales.command, COMMAND)
    clock = ObservationTerm("clock", "-", 1.0, FEET)
    waves = _wave_terms(cfg)
    base_lin_vel = ObservationTerm("base_lin_vel", "m/s", scales.base_lin_vel, POLAR)
    privileged = (
        ObservationTerm("height_error", "m", scales.height_error, Mirror.keep(1.0)),
        ObservationTerm("foot_clearance", "m", scales.foot_clearance, FEET),
        ObservationTerm("foot_force", "N, yaw frame", scales.foot_force, FOOT_VECTORS),
        ObservationTerm("link_collision", "-", 1.0, LINKS),
        ObservationTerm("friction", "half of [-1, 1] over its range", 0.5, Mirror.keep(1.0)),
        ObservationTerm("height_scan", "m", scales.height_scan, scan_mirror(cfg)),
    )
    return {
        "history": frame * cfg.history_length,
        "command": (command,),
        "clock": (clock, *waves),
        "critic": (*frame, command, clock, base_lin_vel, *privileged, *_embodiment_terms(cfg), *waves),
        "estimate": (base_lin_vel, *_embodiment_terms(cfg)),
        "actions": (ObservationTerm("actions", "-", 1.0, SLOTS),),
    }


class ObservationLayout:
    """Columns of every observation group: "history", "command", "clock", "critic", "estimate", and of "actions"."""

    def __init__(self, cfg: ObservationsCfg) -> None:
        """Build the table of what ``cfg`` observes."""
        self.groups = _tables(cfg)
        self.frame_size = sum(term.size for term in _frame_terms(cfg))

    def size(self, group: str) -> int:
        """Number of columns of a group."""
        return sum(term.size for term in self.groups[group])

    def columns(self, group: str, name: str) -> slice:
        """Columns of a term in a group; of its newest frame in "history"."""
        start = 0
        for term in self.groups[group]:
            if term.name == name:
                return slice(start, start + term.size)
            start += term.size
        raise KeyError(f"group {group!r} has no term {name!r}")

    def scale(self, group: str) -> tuple[float, ...]:
        """Factor of each column of a group."""
        return tuple(s for term in self.groups[group] for s in term.scales)

    @property
    def num_scan_points(self) -> int:
        """Points of the height scan, P."""
        columns = self.columns("critic", "height_scan")
        return columns.stop - columns.start

    def mirror(self, device: torch.device | str = "cpu") -> dict[str, tuple[Tensor, Tensor]]:
        """Permutation (int64) and signs (float32) of every group: ``mirrored = x[:, perm] * sign``."""
        mirrors = {name: Mirror.stack([term.mirror for term in terms]) for name, terms in self.groups.items()}
        return {
            name: (torch.tensor(mirror.perm, device=device), torch.tensor(mirror.sign, device=device))
            for name, mirror in mirrors.items()
        }


@lru_cache(maxsize=64)
def scale_vector(cfg: ObservationsCfg, group: str, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Factor of each column of a group as a tensor, shape (columns,), built once."""
    return torch.tensor(ObservationLayout(cfg).scale(group), dtype=dtype, device=device)


SENSED_SIZE = 3 + 3 + 2 * NUM_SLOTS
"""Leading columns of a frame that come from sensors, and so carry noise and latency: all but the last action."""
