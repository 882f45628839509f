"""The commands in force: sampled, or pinned from outside for evaluation and replay."""

from __future__ import annotations

import torch
from torch import Tensor

from .commands import CommandSampler, DrawnCommands


class ActiveCommands:
    """Each environment's command and how often it was drawn."""

    def __init__(self, sampler: CommandSampler, interval_steps: int, dtype: torch.dtype) -> None:
        """Start with zero commands; :meth:`draw` puts the first ones in force.

        Args:
            sampler: draws commands and judges how they were followed.
            interval_steps: control steps between draws within an episode.
            dtype: of the commands.
        """
        self.sampler = sampler
        self._interval = interval_steps
        robot_id = sampler.robot_id
        self.count = torch.zeros_like(robot_id)
        """How often each environment drew, shape (N,)."""
        self.age = torch.zeros_like(robot_id)
        """Control steps for which each command has been in force, shape (N,)."""
        self.command = torch.zeros(len(robot_id), 5, dtype=dtype, device=robot_id.device)
        """(v_x, v_y, omega, h, p), shape (N, 5)."""
        self._pinned: Tensor | None = None

    def pin(self, command: Tensor | None) -> None:
        """Hold these commands, shape (N, 5), instead of sampling; ``None`` returns to sampling at the next draw."""
        self._pinned = None if command is None else command.to(self.command, copy=True)
        if self._pinned is not None:
            self.command = self._pinned
            self.sampler.spoil(slice(None))  # how it is followed is not how the sampled one was

    def draw(self, ids: Tensor) -> None:
        """Put the next commands of some environments in force, shape (n,)."""
        self.close(ids)
        self._begin(ids, self.sampler.draw(ids, self.count[ids]))

    def close(self, ids: Tensor, fallen: Tensor | None = None) -> None:
        """End windows of some environments, shape (n,), before they draw; those that fell, bool (n,), have failed."""
        if fallen is not None and not self.sampler.cfg.redraw_after_fall:
            self.sampler.spoil(ids[fallen])
            ids = ids[~fallen]
        if self._pinned is None:
            self.sampler.close(ids)

    def renew(self, ids: Tensor, fallen: Tensor, drawn: DrawnCommands) -> None:
        """Begin new episodes, shape (n,), under what was drawn for them.

        One that follows a fall, bool (n,), may have to finish the old command instead.
        """
        if self.sampler.cfg.redraw_after_fall:
            self._begin(ids, drawn)
        else:
            self._begin(ids[~fallen], DrawnCommands(*(x[~fallen] for x in drawn)))

    def _begin(self, ids: Tensor, drawn: DrawnCommands) -> None:
        """Put commands in force, unless others are pinned."""
        if not len(ids):
            return
        self.age[ids] = 0
        if self._pinned is None:
            self.sampler.open(ids, drawn)
            self.count[ids] += 1
            self.command = self.command.index_copy(0, ids, drawn.command.to(self.command))

    def judge(self, scores: Tensor) -> None:
        """Credit one step to the windows of the commands, see ``rewards.success_scores``, shape (N, 4)."""
        self.age = self.age + 1
        self.sampler.accumulate(scores)

    def due(self) -> Tensor:
        """Whether each environment's command has been in force for its time, bool, shape (N,)."""
        return self.age >= self._interval

    def log(self) -> dict[str, float]:
        """How far the curriculum has come."""
        return self.sampler.log()

    def state_dict(self) -> dict[str, Tensor]:
        """Commands in force and the curriculum; not what is pinned."""
        return {
            "command": self.command.clone(),
            "count": self.count.clone(),
            "age": self.age.clone(),
            **self.sampler.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.command = state["command"].to(self.command)
        self.count = state["count"].to(self.count, copy=True)
        self.age = state["age"].to(self.age, copy=True)
        self.sampler.load_state_dict(state)
