"""Small learners for the toy robots."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

from eagle_rl.config.schema import AlgoCfg, NetworkCfg, RunCfg
from eagle_rl.runners.on_policy import EagleRunner, make_train_cfg
from eagle_rl.runners.provenance import Provenance
from tests.toy import FRAMES, ToyEnv

torch.set_num_threads(1)

NETWORK = NetworkCfg(
    embedding_dim=8, encoder_dims=(32,), estimator_dims=(16,), actor_dims=(32, 32), critic_dims=(32, 32), init_std=0.5
)
ALGO = AlgoCfg(network=NETWORK, precision="float32", gamma=0.9, num_steps_per_env=8, entropy_coef=0.0)


def make_runner(
    folder: Path | None = None,
    env: ToyEnv | None = None,
    *,
    run: RunCfg | None = None,
    seed: int = 1,
    provenance: Provenance | None = None,
    **algo: Any,
) -> EagleRunner:
    """A runner over the toy robots; ``algo`` overrides settings of the algorithm."""
    cfg = make_train_cfg(
        dataclasses.replace(ALGO, **algo), run or RunCfg(save_interval=1000), history_length=FRAMES, seed=seed
    )
    return EagleRunner(env or ToyEnv(), cfg, folder, provenance=provenance)


def parameters(runner: EagleRunner) -> dict[str, torch.Tensor]:
    """Copies of all learned numbers."""
    models = {"actor": runner.alg.actor, "critic": runner.alg.critic}
    return {f"{name}.{key}": x.detach().clone() for name, m in models.items() for key, x in m.state_dict().items()}


def collect(runner: EagleRunner) -> None:
    """Fill the rollout storage."""
    runner._obs = runner.env.get_observations()
    with torch.no_grad():
        for _ in range(runner.cfg["num_steps_per_env"]):
            runner._step()
        runner.alg.compute_returns(runner._obs)
