"""A trained policy, ready to be judged."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from eagle_rl.config.compose import known_names
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import ConfigError

from .arguments import require_device

if TYPE_CHECKING:
    from tensordict import TensorDict
    from torch import Tensor

    from eagle_rl.models import EagleActor


@dataclass(frozen=True)
class Policy:
    """A policy and where it comes from."""

    checkpoint: Path
    actor: EagleActor
    act: Callable[[TensorDict], Tensor]
    """Its mean actions: the actor's or, of a corrected specialist, those with their correction."""
    cfg: ExperimentCfg
    """The experiment it was trained in, to be run on the device asked for and on all cores of this machine."""
    robots: tuple[str, ...]
    """Those it was trained on, by the names in their files."""
    sha256: str
    """Of its checkpoint."""
    env_steps: int | None
    """What it has cost, if known."""

    def knows(self, robot: str) -> bool:
        """Whether it was trained on a robot, given by name or path; earlier versions kept the path."""
        from envs.robots.load import load_robot

        return not {robot, load_robot(robot).name}.isdisjoint(self.robots)


def load_policy(path: Path, device: str = "cpu") -> Policy:
    """The policy a path means.

    Args:
        path: checkpoint, stage, run or published policy.
        device: where it computes, whatever it was trained on.
    """
    from eagle_rl.config.load import experiment_from_plain
    from eagle_rl.models.correction import CorrectedPolicy
    from eagle_rl.models.precision import set_up_torch
    from eagle_rl.runners.checkpoint import load_actor, load_correction, require_whole
    from eagle_rl.runners.judged import training_steps
    from eagle_rl.runners.locate import find_checkpoint
    from eagle_rl.runners.provenance import slot_table_hash
    from eagle_rl.runners.published import SUFFIX
    from envs.robots.slots import SLOT_NAMES

    require_device(device)
    checkpoint = find_checkpoint(path)
    actor, manifest = load_actor(checkpoint, device, slot_table_hash(SLOT_NAMES))
    require_whole(checkpoint, manifest)
    cfg = experiment_from_plain(manifest["config"], str(checkpoint))
    set_up_torch(1)  # a forward pass is little beside the physics, and waiting threads take the cores from it
    run = dataclasses.replace(cfg.run, device=device, env_device=device, num_threads=0)
    cfg = dataclasses.replace(cfg, run=run)
    correction = load_correction(checkpoint, device)
    act = actor if correction is None else CorrectedPolicy(actor, correction)
    env_steps = manifest["env_steps"] if checkpoint.suffix == SUFFIX else training_steps(checkpoint)
    return Policy(checkpoint, actor, act, cfg, tuple(manifest["robots"]), manifest["sha256"], env_steps)


def chosen_robots(text: str | None, cfg: ExperimentCfg) -> tuple[str, ...]:
    """Robots named on the command line, ``all``, or those of the experiment."""
    names = tuple(known_names("robots")) if text == "all" else tuple(text.split(",")) if text else cfg.robots
    if len(set(names)) < len(names):
        raise ConfigError(f"--robots {text}: a robot is named twice.")
    return names
