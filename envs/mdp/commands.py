"""The five commands: how they are drawn, and the grid curriculum that widens them (paper, Tab. commands; HugWBC 2).

Each robot has its own grid over (v_x, omega). Bins inside the initial box can be drawn from the start; a window of
good tracking opens the bins around its own. Nothing is ever closed again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from eagle_rl.config.schema import CommandCurriculumCfg, CommandsCfg, Range
from eagle_rl.errors import ConfigError

from ..rng import CounterRng
from ..state import PooledRobots

_STREAM = "commands"


def _corner(ranges: Sequence[Range], side: int, device: torch.device) -> Tensor:
    """Lower (side 0) or upper (side 1) ends of some ranges."""
    return torch.tensor([r[side] for r in ranges], dtype=torch.float64, device=device)


class CommandGrid:
    """Bins over the finishing ranges of v_x and omega, v_x outer."""

    def __init__(self, cfg: CommandsCfg, device: torch.device) -> None:
        """Lay out the bins and find those of the initial box."""
        curriculum = cfg.curriculum
        ranges = (cfg.lin_vel_x, cfg.ang_vel_z)
        counts = (curriculum.num_bins_lin_vel_x, curriculum.num_bins_ang_vel_z)
        first, last = (_corner([r.finishing for r in ranges], side, device) for side in (0, 1))
        index = torch.cartesian_prod(*(torch.arange(n, device=device) for n in counts))
        self.width = (last - first) / index.new_tensor(counts)
        """Size of a bin, (v_x [m/s], omega [rad/s]), shape (2,)."""
        self.lower = first + index * self.width
        """Lower corner of each bin, shape (B, 2)."""
        centre = self.lower + 0.5 * self.width
        low, high = (_corner([r.initial for r in ranges], side, device) for side in (0, 1))
        self.initial = ((centre >= low) & (centre <= high)).all(dim=1).to(torch.float64)
        """1 for the bins that are open at the start, shape (B,)."""
        distance = (centre.unsqueeze(1) - centre.unsqueeze(0)).abs()
        self.neighbours = (distance <= curriculum.neighbour_radius + 1e-9).all(dim=2).to(torch.float64)
        """1 where two bins are near, each its own neighbour, shape (B, B)."""
        if not self.initial.any():
            raise ConfigError(
                f"task.commands: the initial ranges of lin_vel_x {ranges[0].initial} and ang_vel_z {ranges[1].initial} "
                f"hold no bin of the grid over the finishing ranges {ranges[0].finishing} and {ranges[1].finishing}; "
                f"widen the initial ranges or use more bins."
            )


def _thresholds(cfg: CommandCurriculumCfg) -> list[float]:
    return [cfg.lin_vel_threshold, cfg.ang_vel_threshold, cfg.contact_force_threshold, cfg.contact_vel_threshold]


class DrawnCommands(NamedTuple):
    """What :meth:`CommandSampler.draw` draws."""

    command: Tensor
    """(v_x, v_y, omega, h, p), float32, shape (n, 5)."""
    bins: Tensor
    """Of the grid, int64, shape (n,)."""
    creditable: Tensor
    """Whether its window counts: no velocity was zeroed, bool, shape (n,)."""


class CommandSampler:
    """Draws commands for environments and remembers how well each window was tracked."""

    def __init__(
        self, cfg: CommandsCfg, robots: PooledRobots, num_robots: int, rng: CounterRng, step_dt: float = 0.02
    ) -> None:
        """Start every robot's curriculum.

        Args:
            cfg: ranges, dead zones, curriculum.
            robots: which robot each environment has.
            num_robots: number of robots R.
            rng: noise of the run.
            step_dt: control step [s].
        """
        self.cfg = cfg
        self.robot_id = robots.robot_id
        self._rng = rng
        self.keys = rng.keys(_STREAM)
        """Of the random stream, shape (N,)."""
        self._grid = CommandGrid(cfg, robots.robot_id.device)
        others = (cfg.lin_vel_y, cfg.base_height, cfg.body_pitch)
        self._initial, self._finishing = (
            torch.stack([_corner(ranges, side, robots.robot_id.device) for side in (0, 1)])
            for ranges in ([r.initial for r in others], [r.finishing for r in others])
        )
        self._thresholds = torch.tensor(_thresholds(cfg.curriculum), dtype=torch.float64, device=robots.robot_id.device)
        self._window_steps = max(1, round(cfg.resampling_time_s / step_dt))
        device, num_envs = robots.robot_id.device, robots.robot_id.shape[0]
        start = self._grid.initial if cfg.curriculum.enabled else torch.ones_like(self._grid.initial)
        self.weights = start.repeat(num_robots, 1)
        """Weight of each robot's bins, float64, shape (R, B)."""
        self._bin = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._creditable = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.sums = torch.zeros(num_envs, 4, dtype=torch.float64, device=device)
        """Success quantities of the open windows, summed over their steps, shape (N, 4)."""

    def accumulate(self, scores: Tensor) -> None:
        """Add one step's success quantities, each 1 at best, shape (N, 4) (see ``rewards.success_scores``)."""
        self.sums = self.sums + scores

    def draw(self, ids: Tensor, count: Tensor) -> DrawnCommands:
        """Draw commands for some environments, shape (n,), that have drawn so often before, (n,); nothing changes."""
        draws = self._rng.uniform(self.keys, count, 8, ids).to(torch.float64)
        command, bins = self._draw(self.robot_id[ids], draws)
        command, zeroed = self._zero_small(command, draws[:, 6] < self.cfg.standing_probability)
        upright = draws[:, 7] < self.cfg.upright_probability
        command[:, 3:] = command[:, 3:].masked_fill(upright.unsqueeze(1), 0.0)
        return DrawnCommands(command.to(torch.float32), bins, ~zeroed)

    def close(self, ids: Tensor) -> None:
        """Close the windows of some environments, shape (n,): what succeeded widens the grid."""
        if self.cfg.curriculum.enabled and len(ids):
            self._credit(ids)

    def open(self, ids: Tensor, drawn: DrawnCommands) -> None:
        """Open windows under what was drawn for some environments, shape (n,)."""
        self._bin[ids] = drawn.bins
        self._creditable[ids] = drawn.creditable
        self.sums[ids] = 0.0

    def spoil(self, ids: Tensor | slice) -> None:
        """Deny success to the open windows of some environments, shape (n,): they fell in them, say."""
        self._creditable[ids] = False

    def _draw(self, robot: Tensor, draws: Tensor) -> tuple[Tensor, Tensor]:
        """Uniform numbers (n, 8) to raw commands (n, 5) and grid bins (n,).

        v_y, height and pitch come from their initial ranges until a robot's grid is complete, then the finishing ones.
        """
        cumulative = self.weights.cumsum(dim=1)[robot]
        bins = (cumulative <= draws[:, :1] * cumulative[:, -1:]).sum(dim=1)
        planar = self._grid.lower[bins] + draws[:, 1:3] * self._grid.width
        complete = (self.weights > 0.0).all(dim=1)[robot]
        low, high = torch.where(complete.view(-1, 1, 1), self._finishing, self._initial).unbind(1)
        others = torch.lerp(low, high, draws[:, 3:6])
        return torch.cat((planar[:, :1], others[:, :1], planar[:, 1:], others[:, 1:]), dim=1), bins

    def _zero_small(self, command: Tensor, stands: Tensor) -> tuple[Tensor, Tensor]:
        """Apply the dead zone and the standing share; also returns whether any velocity was zeroed, shape (n,)."""
        slow = stands | (torch.linalg.vector_norm(command[:, :2], dim=1) <= self.cfg.lin_vel_dead_zone)
        straight = stands | (command[:, 2].abs() <= self.cfg.ang_vel_dead_zone)
        zero = torch.stack((slow, slow, straight), dim=1)
        return torch.cat((command[:, :3].masked_fill(zero, 0.0), command[:, 3:]), dim=1), slow | straight

    def _credit(self, ids: Tensor) -> None:
        """Raise the weights around the bins of successful windows.

        Means are over a whole window, so one cut short by a fall fails; windows with a zeroed velocity do not count.
        """
        curriculum = self.cfg.curriculum
        mean = self.sums[ids] / self._window_steps
        success = (mean > self._thresholds).all(dim=1) & self._creditable[ids]
        winners = ids[success]
        if winners.numel() == 0:
            return
        flat = self.robot_id[winners] * self.weights.shape[1] + self._bin[winners]
        wins = torch.bincount(flat, minlength=self.weights.numel()).to(self.weights).view_as(self.weights)
        gain = curriculum.weight_step * (wins @ self._grid.neighbours)
        self.weights = (self.weights + gain).clamp(max=1.0)

    def state_dict(self) -> dict[str, Tensor]:
        """Weights and open windows."""
        return {
            "weights": self.weights.clone(),
            "bin": self._bin.clone(),
            "creditable": self._creditable.clone(),
            "sums": self.sums.clone(),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.weights = state["weights"].to(self.weights)
        self._bin = state["bin"].to(self._bin, copy=True)
        self._creditable = state["creditable"].to(self._creditable, copy=True)
        self.sums = state["sums"].to(self.sums, copy=True)

    def log(self) -> dict[str, float]:
        """Share of the grid that is open, over all robots and for the slowest one, and how heavy it is."""
        is_open = (self.weights > 0.0).double().mean(dim=1)
        return {
            "Curriculum/command_bins_open": is_open.mean().item(),
            "Curriculum/command_bins_open_min": is_open.min().item(),
            "Curriculum/command_weight": self.weights.mean().item(),
        }


def is_standing(command: Tensor) -> Tensor:
    """Whether all three velocity commands are zero, bool, shape (N,), for commands (N, 5) (HugWBC 1)."""
    return (command[:, :3] == 0).all(dim=1)
