"""The stage that searches a policy's last layer for what its one robot follows commands best with."""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from rich.console import Console
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.algorithms.search import LastLayerSearch
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import EagleWarning, Interrupted
from eagle_rl.evaluation.evaluate import MakeEnv
from eagle_rl.evaluation.trials import Act, PairedTrials
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.runners import checkpoint as ckpt
from eagle_rl.runners.files import patiently
from eagle_rl.runners.interrupt import InterruptGuard
from eagle_rl.runners.plan import Stage
from eagle_rl.runners.progress import ProgressReport
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.training_log import TrainingLog

SAVE_INTERVAL = 10
"""Generations between checkpoints."""


class SearchRunner:
    """Searches around the policy of a checkpoint, of whose learner nothing else changes."""

    def __init__(
        self, cfg: ExperimentCfg, stage: Stage, init: Path, folder: Path, make_env: MakeEnv, provenance: Provenance
    ) -> None:
        """Take the learner of ``init``; write into ``folder``."""
        self.cfg, self.stage, self.folder, self.provenance = cfg, stage, folder, provenance
        self._learner = ckpt.load_checkpoint(init, provenance.slot_table_hash).state
        self._actor = ckpt.load_actor(init, cfg.run.env_device)[0]
        self._trials = PairedTrials(cfg, make_env, stage.seed)
        self._search: LastLayerSearch | None = None
        self.env_steps, self.wall_time = 0, 0.0

    def load(self, path: Path) -> None:
        """Go on where a checkpoint of this search was written."""
        state = ckpt.load_checkpoint(path, self.provenance.slot_table_hash).state
        self._search = LastLayerSearch(self.cfg.search, **state["search"])
        self._trials.load_state_dict([process["env"] for process in state["processes"]])
        self.env_steps, self.wall_time = state["runner"]["env_steps"], state["runner"]["wall_time"]

    def run(self, on_generation: Callable[[], None] = lambda: None) -> Path:
        """Search to the stage's last generation, then save.

        A first SIGINT or SIGTERM ends the search after the generation and raises :class:`Interrupted` once it is saved.

        Returns:
            The final checkpoint.
        """
        search = self._search or self._begin()
        last = self.stage.iterations
        log = TrainingLog(self.folder, self._trials.observations()["robot"], self.stage.robots)
        log.open(search.generation + 1)
        progress = ProgressReport(self.stage.name, search.generation, last)
        with InterruptGuard() as interrupt, progress:
            while search.generation < last:
                scalars = self._generation(search)
                done = search.generation
                log.write(done, scalars)
                progress.update(done, self.env_steps, scalars)
                on_generation()
                if interrupt.requested:
                    raise Interrupted(f"Interrupted after generation {done}, saved as {self._save(search)}.")
                if done % SAVE_INTERVAL == 0 and done < last:
                    self._save(search)
        self._drop_if_worse(search)
        return patiently(lambda: self._save(search, stage_end=True))

    @torch.no_grad()
    def _begin(self) -> LastLayerSearch:
        """A search along the principal directions of the last hidden layer, as the policy moves it."""
        hidden: list[Tensor] = []
        mirrored: list[Tensor] = []

        def act(obs: TensorDict) -> Tensor:
            hidden.append(self._actor.hidden(obs))
            mirrored.append(self._actor.hidden(self._trials.mirrored(obs)))
            return self._actor(obs)

        self._trials.follow(0, self._trials.commands(self.stage.iterations), act)
        self.env_steps += self._trials.steps
        live = self._trials.observations()["slot_mask"][0].nonzero().flatten()
        return LastLayerSearch.along(
            self.cfg.search,
            torch.cat(hidden),
            torch.cat(mirrored),
            slots=live,
            mirror=self._trials.mirror["actions"],
            num_generations=self.stage.iterations,
            seed=self.stage.seed,
        )

    @torch.no_grad()
    def _generation(self, search: LastLayerSearch) -> dict[str, float]:
        """Let both halves of every pair follow the same commands, and take a step; the generation's scalars by tag."""
        start, cpu_start = time.perf_counter(), time.process_time()
        commands = self._trials.commands(search.generation)
        one_way, other_way = (self._changed(search, parameters) for parameters in search.pairs())
        cost, fell = self._trials.compare(commands, (one_way, other_way))
        search.learn(cost[1] - cost[0])
        seconds, steps = time.perf_counter() - start, 2 * self._trials.steps
        self.env_steps += steps
        self.wall_time += seconds
        found = {"Search/cost": cost.mean().item(), "Search/survival": 1.0 - fell.float().mean().item()}
        performance = {
            "Perf/total_fps": steps / seconds,
            "Perf/busy_cores": (time.process_time() - cpu_start) / seconds,
            "Perf/env_steps": self.env_steps,
            "Perf/wall_time": self.wall_time,
        }
        return performance | found | {f"{tag}/{self.cfg.robots[0]}": value for tag, value in found.items()}

    @torch.no_grad()
    def _drop_if_worse(self, search: LastLayerSearch) -> None:
        """End with the policy the search began with, unless what was found follows new commands better.

        Perturbations that are too large for a robot find what is best under perturbations.
        """
        commands = self._trials.commands(self.stage.iterations + 1)
        nothing = torch.zeros_like(search.parameters)
        everywhere = (x.expand(self.cfg.search.num_pairs, -1, -1) for x in (nothing, search.parameters))
        as_begun, as_found = (self._changed(search, parameters) for parameters in everywhere)
        before, after = self._trials.compare(commands, (as_begun, as_found))[0].mean(dim=1).tolist()
        self.env_steps += 2 * self._trials.steps
        outcome = f"{self.stage.name}: cost {before:.3f} -> {after:.3f} on commands that were not searched on"
        if after < before:
            Console(stderr=True).print(outcome, highlight=False)
        else:
            search.parameters = nothing
            warnings.warn(f"{outcome}: nothing better found. Try a smaller search.std.", EagleWarning, stacklevel=2)

    def _changed(self, search: LastLayerSearch, parameters: Tensor) -> Act:
        """The policy with other parameters (P, S, D + 1) in each environment."""

        def last_layer(hidden: Tensor) -> Tensor:
            return search.change(parameters, hidden, self._actor.mlp[-1](hidden))

        def act(obs: TensorDict) -> Tensor:
            history, command, clock = (obs[group] for group in ACTOR_INPUTS)
            return self._actor.outputs(history, command, clock, last_layer)[0] * obs["slot_mask"]

        return act

    def _save(self, search: LastLayerSearch, stage_end: bool = False) -> Path:
        """Write a checkpoint that other stages start from as from any other."""
        actor = copy.deepcopy(self._actor)
        search.fold_into(actor)
        state = self._learner | {
            "algorithm": self._learner["algorithm"] | {"actor_state_dict": actor.state_dict()},
            "runner": {"next_iteration": search.generation, "env_steps": self.env_steps, "wall_time": self.wall_time},
            "processes": [{"env": env} for env in self._trials.state_dict()],
            "search": search.state_dict(),
        }
        path = ckpt.save_checkpoint(
            self.folder / "checkpoints",
            state,
            self.provenance,
            iteration=search.generation,
            env_steps=self.env_steps,
            stage_end=stage_end,
        )
        ckpt.prune_checkpoints(self.folder / "checkpoints", self.cfg.run.keep_checkpoints)
        return path
