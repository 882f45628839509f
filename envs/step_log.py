"""Per-robot averages of rewards, errors and terminations, kept on the device and read once per interval."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from .sim.health import CAUSES

ERROR_NAMES = ("E_vx", "E_vy", "E_omega", "E_h", "E_p")


def episode_ratio(falls_per_step: Tensor, max_episode_length: int) -> Tensor:
    """Mean episode length over the full length at a constant rate of falls, ``(1 - exp(-x)) / x``, shape (R,).

    Unlike the mean of finished episodes it does not wait for the long ones to finish.
    """
    falls = (falls_per_step * max_episode_length).clamp(min=1e-6)
    return -torch.expm1(-falls) / falls


class StepLog:
    """Sums over the steps of an interval, which environments keep for themselves until they are asked for."""

    def __init__(
        self, robot_names: Sequence[str], robot_id: Tensor, terms: Sequence[str], reasons: Sequence[str]
    ) -> None:
        """Start empty.

        Args:
            robot_names: names of the robots.
            robot_id: each environment's robot, shape (N,).
            terms: names of the reward terms.
            reasons: names of what ends episodes.
        """
        self._names = tuple(robot_names)
        self._robot_id = robot_id
        counts = torch.bincount(robot_id, minlength=len(robot_names)).to(torch.float64)
        self._num_envs = counts.unsqueeze(1)
        self._cause_codes = torch.arange(1, len(CAUSES) + 1, device=robot_id.device)
        self._columns = (
            *(f"Episode_Reward/{name}" for name in terms),
            *(f"Episode_Termination/{name}" for name in reasons),
            *(f"Health/{cause}" for cause in CAUSES),
            *(f"Metrics/{name}" for name in ERROR_NAMES),
            *("match", "moving", "falls", "dones"),
        )
        self.sums = torch.zeros(len(robot_id), len(self._columns), device=robot_id.device)
        """Float32, shape (N, columns)."""

    def add(
        self,
        terms: Sequence[Tensor],
        reasons: Sequence[Tensor],
        causes: Tensor,
        errors: Tensor,
        contact_match: Tensor,
        falls: Tensor,
        dones: Tensor,
        standing: Tensor,
    ) -> None:
        """Add one step.

        Args:
            terms: weighted reward terms, shape (N,) each.
            reasons: what ended episodes, bool, shape (N,) each.
            causes: codes of what is wrong with environments, see ``envs.sim.health.CAUSES``, shape (N,).
            errors: tracking errors in the order of ``ERROR_NAMES``, shape (N, 5).
            contact_match: share of feet that agree with the clock, shape (N,).
            falls: episodes that ended before their time, bool, shape (N,).
            dones: episodes that ended, bool, shape (N,).
            standing: whether the command is to stand, bool, shape (N,).
        """
        blocks = (
            torch.stack(tuple(terms), dim=1) if terms else errors[:, :0],
            torch.stack(tuple(reasons), dim=1),
            causes.unsqueeze(1) == self._cause_codes,
            errors,
            torch.stack((contact_match.masked_fill(standing, 0.0), ~standing, falls, dones), dim=1),
        )
        before = self.sums.split([block.shape[1] for block in blocks], dim=1)
        self.sums = torch.cat([x + block.to(x.dtype) for x, block in zip(before, blocks, strict=True)], dim=1)

    def flush(self, num_steps: int) -> tuple[dict[str, float], Tensor, Tensor]:
        """Return the interval's tags, each robot's falls per step (R,) and contact match (R,), and start anew.

        Rewards are per second, terminations are shares of the episodes that ended, errors are means over steps, causes
        of sickness are counted, and ``Health/sick_share`` is their sum as a share of the environment steps.

        Args:
            num_steps: control steps that were added.
        """
        sums = self._num_envs.new_zeros(len(self._names), len(self._columns))
        sums.index_add_(0, self._robot_id, self.sums.double())
        counts = Counter(tag.partition("/")[0] for tag in self._columns[:-4])
        kinds = ("Episode_Reward", "Episode_Termination", "Health", "Metrics")
        rewards, terminations, causes, errors, last = sums.split([*(counts[kind] for kind in kinds), 4], dim=1)
        match, moving, falls, dones = last.split(1, dim=1)
        env_steps = self._num_envs * num_steps
        match, falls_per_step = match / moving.clamp(min=1.0), falls / env_steps
        table = torch.cat(
            (
                rewards / env_steps * 50.0,
                terminations / dones.clamp(min=1.0),
                causes,
                errors / env_steps,
                causes.sum(dim=1, keepdim=True) / env_steps,
                match,
                falls_per_step * 1000.0,
            ),
            dim=1,
        )
        self.sums = torch.zeros_like(self.sums)
        entry = dict(zip(_tags(self._columns, self._names), table.flatten().tolist(), strict=True))
        return entry, falls_per_step.squeeze(1), match.squeeze(1)

    def state_dict(self) -> dict[str, Tensor]:
        """The sums of the unfinished interval."""
        return {"sums": self.sums.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.sums = state["sums"].to(self.sums, copy=True)


@lru_cache(maxsize=8)
def _tags(columns: tuple[str, ...], names: tuple[str, ...]) -> list[str]:
    """Tags of a flush: how a ``StepLog`` calls its columns, the last four worked up, for each robot."""
    told = (*columns[:-4], "Health/sick_share", "Metrics/contact_match", "Metrics/falls_per_1000_steps")
    return [f"{column}/{name}" for name in names for column in told]
