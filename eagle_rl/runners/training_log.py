"""Everything a run says about itself: TensorBoard, ``metrics.jsonl``, and warnings where saying fails."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from eagle_rl.algorithms.running_means import RunningMeans
from eagle_rl.runners.event_file import EventFile
from eagle_rl.runners.files import append_whole, write_atomically
from eagle_rl.runners.throttle import ThrottledWarning

EPISODES = 100
"""Finished episodes of each robot over which rewards and lengths are averaged."""


class EpisodeStatistics:
    """Rewards and lengths of the episodes that finished last, per robot."""

    def __init__(self, robot: Tensor, robot_names: Sequence[str]) -> None:
        """Follow environments whose robots are ``robot`` (N,), indices into ``robot_names``."""
        self._robot = robot.tolist()
        self._names = list(robot_names)
        self._reward = torch.zeros(len(robot), device=robot.device)
        self._length = torch.zeros(len(robot), device=robot.device)
        self._steps: list[Tensor] = []
        self._finished: list[deque[tuple[float, float]]] = [deque(maxlen=EPISODES) for _ in robot_names]

    def add(self, rewards: Tensor, dones: Tensor) -> None:
        """Take rewards (N,) and dones (N,) of one step; nothing is transferred to the host."""
        done = dones.to(self._reward.dtype)
        self._reward = self._reward + rewards
        self._length = self._length + 1
        self._steps.append(torch.stack([done, self._reward, self._length]))
        self._reward = self._reward * (1 - done)
        self._length = self._length * (1 - done)

    def collect(self) -> dict[str, float]:
        """Means over the last finished episodes, pooled and per robot, by tag."""
        done, reward, length = torch.stack(self._steps, dim=1).cpu()
        self._steps = []
        steps, envs = done.nonzero(as_tuple=True)
        rows = zip(envs.tolist(), reward[steps, envs].tolist(), length[steps, envs].tolist(), strict=True)
        for env, total, age in rows:
            self._finished[self._robot[env]].append((total, age))
        tags: dict[str, float] = {}
        episodes = {f"/{name}": list(f) for name, f in zip(self._names, self._finished, strict=True)}
        for suffix, last in (episodes | {"": [e for f in self._finished for e in f]}).items():
            if last:
                tags[f"Train/mean_reward{suffix}"] = fmean(total for total, _ in last)
                tags[f"Train/mean_episode_length{suffix}"] = fmean(age for _, age in last)
        return tags

    def state_dict(self) -> dict[str, Any]:
        """State between iterations."""
        finished = [[list(row) for row in rows] for rows in self._finished]
        return {"reward": self._reward, "length": self._length, "finished": finished}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self._reward = state["reward"].to(self._reward)
        self._length = state["length"].to(self._length)
        rows = state["finished"]
        self._finished = [deque(((r, n) for r, n in robot), maxlen=EPISODES) for robot in rows]


class TrainingLog:
    """Collects scalars during an iteration and writes them at its end; a failure to write never stops training."""

    def __init__(self, folder: Path | None, robot: Tensor, robot_names: Sequence[str]) -> None:
        """Write into ``folder``, or nowhere."""
        self.folder = folder
        self.episodes = EpisodeStatistics(robot, robot_names)
        self.warn = ThrottledWarning()
        self._extras = RunningMeans()
        self._events: EventFile | None = None

    def add_step(self, rewards: Tensor, dones: Tensor, extras: Mapping[str, Any]) -> None:
        """Take what one environment step returned."""
        self.episodes.add(rewards, dones)
        self._extras.add(extras.get("log", {}))

    def collect(self) -> dict[str, float]:
        """Scalars of the environment over the iteration, by tag."""
        return self.episodes.collect() | self._extras.pop()

    def open(self, next_iteration: int) -> None:
        """Start writing; what an earlier process wrote beyond the checkpoint it resumes from is dropped."""
        if self.folder is None:
            return
        self._events = EventFile(self.folder)
        with self._tolerant():
            self.folder.mkdir(parents=True, exist_ok=True)
            self._truncate_metrics(self.folder / "metrics.jsonl", next_iteration)

    def write(self, iteration: int, scalars: Mapping[str, float]) -> None:
        """Append the scalars of one iteration."""
        if self.folder is None or self._events is None:
            return
        with self._tolerant():
            line = json.dumps({"iteration": iteration} | {k: _json_number(v) for k, v in scalars.items()})
            append_whole(self.folder / "metrics.jsonl", line.encode() + b"\n")
        with self._tolerant():
            self._events.write(iteration, scalars)

    def _truncate_metrics(self, path: Path, next_iteration: int) -> None:
        if path.exists():
            kept = [line for line in path.read_text().splitlines() if 0 <= _iteration(line) < next_iteration]
            write_atomically(path, "".join(line + "\n" for line in kept).encode())

    @contextmanager
    def _tolerant(self) -> Iterator[None]:
        """Turn a failure to log into a warning."""
        try:
            yield
        except OSError as error:
            self.warn(f"Logging to {self.folder} fails, training goes on: {error}")


def _json_number(value: float) -> float | str:
    """JSON has no word for numbers that are not finite."""
    return value if math.isfinite(value) else str(value)


def _iteration(line: str) -> int:
    """Iteration of a line of metrics, -1 if the line is torn."""
    try:
        return int(json.loads(line)["iteration"])
    except (ValueError, KeyError, TypeError):
        return -1
