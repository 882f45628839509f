"""An untrained policy in a checkpoint, for tests of what is done with trained ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.models import EagleActor
from eagle_rl.runners.checkpoint import save_checkpoint
from eagle_rl.runners.provenance import Provenance, slot_table_hash
from envs.mdp.layout import ObservationLayout
from envs.robots.slots import NUM_SLOTS, SLOT_NAMES


def untrained_actor(cfg: ExperimentCfg) -> EagleActor:
    """The policy an experiment would start with."""
    torch.manual_seed(0)
    layout, network = ObservationLayout(cfg.task.observations), cfg.algo.network
    return EagleActor.from_architecture(
        {
            "observations": {group: layout.size(group) for group in ("history", "command", "clock", "estimate")},
            "num_actions": NUM_SLOTS,
            "networks": {
                "history_length": cfg.task.observations.history_length,
                "hidden_dims": network.actor_dims,
                "encoder_dims": network.encoder_dims,
                "estimator_dims": network.estimator_dims,
                "embedding_dim": network.embedding_dim,
                "activation": network.activation,
                "init_std": network.init_std,
                "std_range": network.std_range,
            },
        }
    ).eval()


def untrained_checkpoint(folder: Path, *robots: str) -> Path:
    """A checkpoint of such a policy."""
    cfg = ExperimentCfg(name="untrained", robots=robots)
    actor = untrained_actor(cfg)
    state = {"architecture": actor.architecture, "algorithm": {"actor_state_dict": actor.state_dict()}}
    provenance = Provenance(
        config=dataclasses.asdict(cfg),
        robots=dict.fromkeys(robots, ""),
        slot_table_hash=slot_table_hash(SLOT_NAMES),
    )
    return save_checkpoint(folder, state, provenance, iteration=1, env_steps=0)
