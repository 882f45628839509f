"""Does e(s_t) tell the robots apart? Embeddings of walking robots, two numbers and a map (paper, Fig. t-SNE)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.manifold import TSNE
from sklearn.metrics import silhouette_score
from sklearn.preprocessing import StandardScaler

from eagle_rl.config.schema import EvaluationCfg, TaskCfg
from eagle_rl.errors import ConfigError
from eagle_rl.evaluation.evaluate import MakeEnv
from eagle_rl.evaluation.protocol import evaluation_task
from eagle_rl.models import EagleActor

WALK_FORWARD = (0.6, 0.0, 0.0, 0.0, 0.0)
"""The command under which embeddings are compared: half of the greatest forward speed."""


@dataclass(frozen=True, kw_only=True)
class Embeddings:
    """e(s_t) of walking robots."""

    robots: tuple[str, ...]
    features: NDArray[np.float32]
    """Shape (M, E)."""
    robot: NDArray[np.int64]
    """Index into ``robots``, shape (M,)."""
    env: NDArray[np.int64]
    """Which of its robot's environments each row comes from, shape (M,)."""


@torch.inference_mode()
def collect_embeddings(
    actor: EagleActor,
    make_env: MakeEnv,
    robots: Sequence[str],
    task: TaskCfg,
    ev: EvaluationCfg,
    *,
    num_envs: int = 16,
    warm_up_steps: int = 100,
    num_samples: int = 20,
    stride: int = 5,
) -> Embeddings:
    """Let every robot walk forward and keep e(s_t) now and then; environments that fell are left out.

    Args:
        actor: the policy.
        make_env: builds the environments.
        robots: robots to compare.
        task: the task the policy was trained in.
        ev: seed, physics and noise; dynamics are randomized, without pushes, so that a robot's environments differ.
        num_envs: environments per robot.
        warm_up_steps: control steps before the first sample.
        num_samples: samples per environment.
        stride: control steps between samples.
    """
    steps = warm_up_steps + stride * num_samples
    calm = replace(task, randomization=replace(task.randomization, push_lin_vel=0.0, push_ang_vel=0.0))
    task = evaluation_task(calm, replace(ev, num_steps=steps, randomization=True))
    features, labels, sources = [], [], []
    for label, robot in enumerate(robots):
        env = make_env([robot], num_envs, task, ev.seed)
        env.pin_commands(torch.tensor(WALK_FORWARD).expand(num_envs, -1))
        alive = torch.ones(num_envs, dtype=torch.bool)
        for t in range(steps):
            _, _, dones, _ = env.step(actor(env.get_observations()))
            alive &= ~dones.bool().cpu()
            if t >= warm_up_steps and (t - warm_up_steps) % stride == 0:
                ids = alive.nonzero().squeeze(1)
                features.append(actor.embedding.cpu()[ids].numpy())
                labels.append(np.full(len(ids), label))
                sources.append(ids.numpy())
    return Embeddings(
        robots=tuple(robots),
        features=np.concatenate(features),
        robot=np.concatenate(labels),
        env=np.concatenate(sources),
    )


def _require_several(embeddings: Embeddings) -> None:
    walking = len(np.unique(embeddings.robot))
    if walking < 2:
        raise ConfigError(
            f"Latents compare robots, but only {walking} of {len(embeddings.robots)} kept walking upright."
        )


def silhouette(embeddings: Embeddings) -> float:
    """Silhouette score of the robots' clusters: 1 well separated, 0 overlapping, -1 mixed up."""
    _require_several(embeddings)
    size = min(5000, len(embeddings.features))
    return float(silhouette_score(embeddings.features, embeddings.robot, sample_size=size, random_state=0))


def probe_accuracy(embeddings: Embeddings) -> float:
    """Share of samples whose robot a linear classifier names; trained on even environments, tested on odd ones.

    Raises:
        ConfigError: a robot has samples for one of both alone.
    """
    _require_several(embeddings)
    train = embeddings.env % 2 == 0
    halves = (set(embeddings.robot[half].tolist()) for half in (train, ~train))
    if one_sided := set.symmetric_difference(*halves):
        names = ", ".join(embeddings.robots[i] for i in sorted(one_sided))
        raise ConfigError(
            "The probe of latents is trained on every second environment of a robot and tested on the others, but "
            f"{names} walked in one half alone. Expected at least 2 environments a robot (--envs), more if robots fall."
        )
    scaler = StandardScaler().fit(embeddings.features[train])
    probe = LogisticRegression(max_iter=1000).fit(scaler.transform(embeddings.features[train]), embeddings.robot[train])
    return float(probe.score(scaler.transform(embeddings.features[~train]), embeddings.robot[~train]))


def tsne(embeddings: Embeddings, seed: int = 0) -> NDArray[np.float32]:
    """A map of the embeddings in the plane, shape (M, 2)."""
    perplexity = min(30.0, (len(embeddings.features) - 1) / 3)
    return TSNE(perplexity=perplexity, init="pca", random_state=seed).fit_transform(embeddings.features)
