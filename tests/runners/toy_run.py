"""A whole experiment on toy robots, small enough for a test."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from eagle_rl.config.schema import (
    AlgoCfg,
    CorrectionCfg,
    EvaluationCfg,
    ExperimentCfg,
    NetworkCfg,
    ObservationsCfg,
    PlanCfg,
    RunCfg,
    SearchCfg,
    TaskCfg,
)
from eagle_rl.evaluation.evaluate import MakeEnv
from eagle_rl.runners.plan import Stage
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.root import clock_columns
from eagle_rl.runners.stages import RunResult
from eagle_rl.runners.training import Job
from tests.toy import FRAMES, ToyEnv

ENVS, STEPS = 12, 4

NETWORK = NetworkCfg(
    embedding_dim=8, encoder_dims=(16,), estimator_dims=(16,), actor_dims=(16,), critic_dims=(16,), activation="elu"
)


class JudgedToyEnv(ToyEnv):
    """The toy with what an evaluation asks of an environment."""

    pinned: Tensor | None = None

    def pin_commands(self, command: Tensor | None) -> None:
        self.pinned = command
        if command is not None:
            self.command = command.float()

    def _reset(self, ids: Tensor) -> None:
        super()._reset(ids)
        if self.pinned is not None:
            self.command = self.pinned.float()

    def measured_commands(self) -> Tensor:
        return self.frames[:, 0, :5]

    slot_names = ("joint",)

    def balance(self) -> tuple[Tensor, Tensor]:
        return torch.zeros(self.num_envs, 3), torch.zeros(self.num_envs, 1, dtype=torch.bool)

    def tracking_errors(self) -> Tensor:
        return (self.measured_commands() - self.command).abs()


def make_toy_env(robots: Sequence[str], num_envs: int, task: TaskCfg, seed: int, first: int = 0) -> JudgedToyEnv:
    return JudgedToyEnv(num_envs, tuple(robots), seed, waves=clock_columns(task.observations) - 2)


def toy_experiment(iterations: int = 3, judge_envs: int = 4, **plan: object) -> ExperimentCfg:
    """Three robots, a few iterations a stage."""
    steps = ENVS * STEPS * iterations
    keys = ("generalist_env_steps", "specialist_env_steps", "distill_env_steps", "base_env_steps")
    budgets = dict.fromkeys(keys, steps)
    return ExperimentCfg(
        name="toy",
        robots=("one", "two", "three"),
        num_envs=ENVS,
        task=TaskCfg(observations=ObservationsCfg(history_length=FRAMES)),
        algo=AlgoCfg(num_steps_per_env=STEPS, num_learning_epochs=1, num_mini_batches=2, network=NETWORK),
        plan=PlanCfg(**{"method": "eagle", "judge_envs_per_robot": judge_envs, **budgets, **plan}),  # type: ignore[arg-type]
        search=SearchCfg(num_pairs=4, num_steps=5, settling_steps=1, resampling_time_s=0.04),
        correction=CorrectionCfg(num_envs=4, num_steps=12, settling_steps=2),
        evaluation=EvaluationCfg(num_steps=5),
        run=RunCfg(save_interval=1),
    )


def toy_job(cfg: ExperimentCfg, stage: Stage, folder: Path, make_env: MakeEnv = make_toy_env, rank: int = 0) -> Job:
    """A stage without inputs, to be trained by itself."""
    return Job(
        cfg=cfg,
        stage=stage,
        folder=folder,
        init=None,
        teachers=(),
        start=None,
        base=None,
        critic=None,
        make_env=make_env,
        provenance=Provenance(),
        check_claim=lambda: None,
        rank=rank,
    )


def refuse(*args: object) -> None:
    """For who is to build no environments."""
    raise AssertionError("nobody builds environments here")


def parameters(result: RunResult) -> dict[str, Tensor]:
    """Final weights of the generalist."""
    return torch.load(result.generalist, weights_only=True)["algorithm"]["actor_state_dict"]
