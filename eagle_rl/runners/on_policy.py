"""The training loop: collect, update, log, save, and go on exactly where it stopped."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner

from eagle_rl.algorithms.eagle_ppo import EaglePPO
from eagle_rl.config.schema import AlgoCfg, RunCfg
from eagle_rl.errors import CheckpointError, EagleWarning, HealthError, Interrupted
from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.runners import checkpoint as ckpt
from eagle_rl.runners.files import patiently
from eagle_rl.runners.health import SickRule, require_sound
from eagle_rl.runners.interrupt import InterruptGuard
from eagle_rl.runners.progress import ProgressReport
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.team import join_processes, over_processes
from eagle_rl.runners.training_log import TrainingLog


def make_train_cfg(algo: AlgoCfg, run: RunCfg, *, history_length: int = 5, seed: int = 1) -> dict[str, Any]:
    """The configuration rsl_rl's runner and algorithm take.

    Args:
        algo: losses, schedule and networks.
        run: device and checkpoints.
        history_length: K of the environment's history group.
        seed: seeds initial weights, action noise and minibatches.
    """
    net = algo.network
    return {
        "seed": seed,
        "num_steps_per_env": algo.num_steps_per_env,
        "save_interval": run.save_interval,
        "keep_checkpoints": run.keep_checkpoints,
        "obs_groups": {"actor": list(ACTOR_INPUTS), "critic": ["critic"], "estimate": ["estimate"]},
        "algorithm": {"class_name": EaglePPO, "cfg": algo},
        "actor": {
            "class_name": EagleActor,
            "history_length": history_length,
            "hidden_dims": net.actor_dims,
            "encoder_dims": net.encoder_dims,
            "estimator_dims": net.estimator_dims,
            "embedding_dim": net.embedding_dim,
            "activation": net.activation,
            "init_std": net.init_std,
            "std_range": net.std_range,
        },
        "critic": {"class_name": "MLPModel", "hidden_dims": net.critic_dims, "activation": net.activation},
    }


class EagleRunner(OnPolicyRunner):
    """Trains one policy in one environment; one stage of a run."""

    alg: EaglePPO

    def __init__(
        self,
        env: VecEnv,
        train_cfg: dict[str, Any],
        log_dir: Path | str | None = None,
        device: str = "cpu",
        provenance: Provenance | None = None,
    ) -> None:
        """Build the learner for ``env`` from :func:`make_train_cfg`; write under ``log_dir``, or nowhere."""
        torch.manual_seed(train_cfg["seed"])
        with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints every layer
            super().__init__(env, train_cfg, None, device)
        if self.is_distributed:
            self.alg.broadcast_parameters()
            env.over_processes = over_processes
        torch.manual_seed(train_cfg["seed"] + self.gpu_global_rank)
        self.provenance = provenance or Provenance()
        self.folder = Path(log_dir) if log_dir is not None and self.gpu_global_rank == 0 else None
        self.robot = env.get_observations()["robot"].to(device)
        self.logger = TrainingLog(self.folder, self.robot, env.robot_names)
        env.fault_folder = self.folder / "faults" if self.folder is not None else None
        self._sick_rule = SickRule(self._env_steps_per_robot(), env.fault_folder)
        self.env_steps = 0
        self.wall_time = 0.0
        self._score: float | None = None
        self._saved: Path | None = None
        """Checkpoint that holds the present state."""

    # --- training ---------------------------------------------------------------------------------------------------

    def learn(
        self,
        num_learning_iterations: int,
        init_at_random_ep_len: bool = True,
        on_iteration: Callable[[int], None] = lambda iteration: None,
    ) -> Path | None:
        """Train, then save.

        A first SIGINT or SIGTERM ends training after the iteration and raises :class:`Interrupted` once it is saved.

        Args:
            num_learning_iterations: iterations to add to those done.
            init_at_random_ep_len: spread the ages of the first episodes, so that not all end at once.
            on_iteration: told the number of iterations done after each.

        Returns:
            The final checkpoint; None where nothing is written.
        """
        last = self.current_learning_iteration + num_learning_iterations
        if init_at_random_ep_len and self.current_learning_iteration == 0:
            self.env.stagger()
        self.alg.train_mode()
        self._obs = self.env.get_observations().to(self.device)
        self.logger.open(self.current_learning_iteration + 1)
        progress = ProgressReport(self.provenance.stage, self.current_learning_iteration, last)
        try:
            with InterruptGuard() as interrupt, progress:
                while self.current_learning_iteration < last:
                    scalars = self._iterate()
                    self.logger.write(self.current_learning_iteration, scalars)
                    self._sick_rule.check(scalars)
                    if self.gpu_global_rank == 0:
                        progress.update(self.current_learning_iteration, self.env_steps, scalars)
                    self._score = scalars.get("Train/mean_reward")
                    if self.current_learning_iteration < last:
                        self._save_now_and_then()
                    on_iteration(self.current_learning_iteration)
                    if self._any_process(interrupt.requested):
                        done, saved = self.current_learning_iteration, self.save()
                        raise Interrupted(f"Interrupted after iteration {done}, saved as {saved or 'rank 0 says'}.")
        except HealthError as error:
            if not self.is_distributed:  # the other processes cannot be asked for their part of the state
                self._save_before_stopping(error)
            raise
        return self.save(stage_end=True)

    def _iterate(self) -> dict[str, float]:
        """Collect one rollout and learn from it; return the iteration's scalars by tag."""
        start, cpu_start = time.perf_counter(), time.process_time()
        self.alg.stopwatch.reset()
        with torch.no_grad():  # not inference_mode: the environment keeps its tensors and may change them in place
            for _ in range(self.cfg["num_steps_per_env"]):
                self._step()
            self.alg.compute_returns(self._obs)
            self.alg.stopwatch.lap("storage")
        collected = time.perf_counter()
        losses = self.alg.update()
        learned = time.perf_counter()
        self.current_learning_iteration += 1
        self._saved = None
        steps = self.cfg["num_steps_per_env"] * self.env.num_envs * self.gpu_world_size
        self.env_steps += steps
        self.wall_time += learned - start
        std = self.alg.storage.distribution_params[1]
        own = {
            "Loss/learning_rate": self.alg.learning_rate,
            "Policy/mean_std": (std.sum() / (std > 0).sum()).item(),
            "Perf/total_fps": steps / (learned - start),
            "Perf/collection_time": collected - start,
            "Perf/learning_time": learned - collected,
            "Perf/busy_cores": (time.process_time() - cpu_start) / (learned - start),
            "Perf/env_steps": self.env_steps,
            "Perf/wall_time": self.wall_time,
        }
        logged = self.logger.collect()
        self.alg.stopwatch.lap("logging")
        return logged | losses | own | {f"Perf/{name}_time": t for name, t in self.alg.stopwatch.seconds.items()}

    def _env_steps_per_robot(self) -> dict[str, int]:
        """Environment steps of each robot in an iteration of this process."""
        counts = torch.bincount(self.robot, minlength=len(self.env.robot_names)).tolist()
        steps: int = self.cfg["num_steps_per_env"]
        return {name: n * steps for name, n in zip(self.env.robot_names, counts, strict=True)}

    def _step(self) -> None:
        """One control step of every environment."""
        stopwatch = self.alg.stopwatch
        actions = self.alg.act(self._obs)
        stopwatch.lap("inference")
        obs, rewards, dones, extras = self.env.step(actions.to(self.env.device))
        stopwatch.lap("MDP")
        stopwatch.move(extras.get("physics_time", 0.0), "MDP", "physics")
        self._obs, rewards, dones = obs.to(self.device), rewards.to(self.device), dones.to(self.device)
        tensors = {name: x for name, x in self._obs.items() if x.is_floating_point()} | {"rewards": rewards}
        require_sound(tensors, self.robot, self.env.robot_names)
        stopwatch.lap("logging")
        self.alg.process_env_step(self._obs, rewards, dones, extras)
        stopwatch.lap("storage")
        self.logger.add_step(rewards, dones, extras)
        stopwatch.lap("logging")

    # --- checkpoints ------------------------------------------------------------------------------------------------

    def save(self, stage_end: bool = False) -> Path | None:
        """Write a checkpoint, unless one holds this state already, and return its path.

        Args:
            stage_end: mark it as the end of its stage, which is never pruned; it is waited for while the disk is full.

        Returns:
            None in processes that do not write.
        """
        state = self._state()
        if self.folder is None:
            return None
        self._require_finite_parameters()
        folder = self.folder / "checkpoints"
        try:
            return patiently(lambda: self._write(folder, state, True)) if stage_end else self._write(folder, state)
        except OSError as error:
            raise CheckpointError(
                f"{folder}: the checkpoint of iteration {self.current_learning_iteration} could not be written: "
                f"{error.strerror}. The last good checkpoint stays and can be resumed."
            ) from error

    def _write(self, folder: Path, state: dict[str, Any], stage_end: bool = False) -> Path:
        if self._saved is not None and self._saved.exists():
            return ckpt.mark_stage_end(self._saved) if stage_end else self._saved
        self._saved = ckpt.save_checkpoint(
            folder,
            state,
            self.provenance,
            iteration=self.current_learning_iteration,
            env_steps=self.env_steps,
            score=self._score,
            stage_end=stage_end,
        )
        ckpt.prune_checkpoints(folder, self.cfg["keep_checkpoints"])
        return self._saved

    def _save_before_stopping(self, reason: HealthError) -> None:
        """Save what there is; where that fails say so, and leave the reason to be told."""
        try:
            self.save()
        except (CheckpointError, HealthError) as error:
            warnings.warn(f"{error} The run stops because of another fault: {reason}", EagleWarning, stacklevel=2)

    def load(self, path: Path | str, *, allow_drift: bool = False) -> None:
        """Go on exactly where a checkpoint was written; nothing changes unless all of it fits.

        With ``allow_drift`` a run goes on although configuration, robots or versions have changed, and is marked.
        """
        checkpoint = ckpt.load_checkpoint(Path(path), self.provenance.slot_table_hash)
        changes = self.provenance.differences(checkpoint.manifest)
        if changes and not allow_drift:
            listed = "\n  ".join(changes)
            raise CheckpointError(
                f"{checkpoint.path}: cannot be resumed bit for bit, these have changed:\n  {listed}\n"
                "Undo the changes, or go on with --allow-drift, which marks the run."
            )
        self._load_state(checkpoint)
        drifted = self.provenance.drifted or bool(changes) or checkpoint.manifest["drifted"]
        self.provenance = dataclasses.replace(self.provenance, drifted=drifted)

    def load_weights(self, path: Path | str) -> None:
        """Start from the learner of a checkpoint: policy, critic, optimiser and learning rate; the rest stays fresh.

        A fresh optimiser at the first learning rate would undo a trained policy in its first update. Imitation alone
        has a fresh one: measured by PPO's gradients its first steps would be several times as long as its rate says.
        """
        checkpoint = ckpt.load_checkpoint(Path(path), self.provenance.slot_table_hash)
        self.require_same_shapes(checkpoint)
        goes_on = self.alg.cfg.use_ppo_loss
        self.alg.load(checkpoint.state["algorithm"], {"actor": True, "critic": True, "optimizer": goes_on})

    def _state(self) -> dict[str, Any]:
        """Everything a checkpoint holds; the part of each process is gathered in the first."""
        local = self._local_state()
        processes = [local]
        if self.is_distributed:
            processes = [{}] * self.gpu_world_size
            torch.distributed.gather_object(local, processes if self.gpu_global_rank == 0 else None)
        return {
            "architecture": self.alg.actor.architecture,
            "algorithm": self.alg.save(),
            "runner": self._counters(),
            "processes": processes,
        }

    def _local_state(self) -> dict[str, Any]:
        """The part of the state that each process has its own of."""
        episodes = self.logger.episodes.state_dict()
        return {"env": self.env.state_dict(), "episodes": episodes, "rng": self._rng_state()}

    def _counters(self) -> dict[str, float]:
        return {
            "next_iteration": self.current_learning_iteration,
            "env_steps": self.env_steps,
            "wall_time": self.wall_time,
        }

    def _load_state(self, checkpoint: ckpt.Checkpoint) -> None:
        state = checkpoint.state
        processes = state.get("processes", ())
        if len(processes) != self.gpu_world_size:
            raise CheckpointError(
                f"{checkpoint.path}: written by {len(processes)} processes, resumed by {self.gpu_world_size}. "
                "Resume with as many processes."
            )
        self.require_same_shapes(checkpoint)
        local = processes[self.gpu_global_rank]
        self._require_fit(checkpoint, local)
        self.env.load_state_dict(local["env"])
        self.alg.load(state["algorithm"])
        self.logger.episodes.load_state_dict(local["episodes"])
        self.current_learning_iteration = state["runner"]["next_iteration"]
        self.env_steps = state["runner"]["env_steps"]
        self.wall_time = state["runner"]["wall_time"]
        self._score = checkpoint.manifest["score"]
        own = self.folder is not None and checkpoint.path.parent.resolve() == (self.folder / "checkpoints").resolve()
        self._saved = checkpoint.path if own else None
        torch.set_rng_state(local["rng"]["cpu"])
        if "cuda" in local["rng"]:
            torch.cuda.set_rng_state(local["rng"]["cuda"], self.device)

    def _rng_state(self) -> dict[str, torch.Tensor]:
        cuda = {"cuda": torch.cuda.get_rng_state(self.device)} if str(self.device).startswith("cuda") else {}
        return {"cpu": torch.get_rng_state()} | cuda

    def _save_now_and_then(self) -> None:
        """Save every ``save_interval`` iterations; where that fails, training goes on and says so."""
        if self.current_learning_iteration % self.cfg["save_interval"] == 0:
            try:
                self.save()
            except CheckpointError as error:
                self.logger.warn(f"{error} Training goes on.")

    def require_same_shapes(self, checkpoint: ckpt.Checkpoint, networks: Sequence[str] = ("actor", "critic")) -> None:
        """Refuse weights that do not fit, before any is changed."""
        for name in networks:
            own = {key: tuple(x.shape) for key, x in getattr(self.alg, name).state_dict().items()}
            saved = {key: tuple(x.shape) for key, x in checkpoint.state["algorithm"][f"{name}_state_dict"].items()}
            wrong = [f"{k}: {saved.get(k)}, expected {own.get(k)}" for k in own | saved if own.get(k) != saved.get(k)]
            if wrong:
                raise CheckpointError(
                    f"{checkpoint.path}: its {name} has other shapes than this experiment's:\n  "
                    + "\n  ".join(wrong)
                    + "\nUse the algo.network and task.observations it was trained with."
                )

    def _require_fit(self, checkpoint: ckpt.Checkpoint, local: dict[str, Any]) -> None:
        """Refuse a state that is not of this environment and learner, before any of it is taken over."""
        own = {"process": self._local_state(), "runner": self._counters(), "algorithm": self.alg.save()}
        saved = {"process": local} | {key: checkpoint.state.get(key, {}) for key in ("runner", "algorithm")}
        for state in (own, saved):  # torch checks the optimiser's itself, which is empty before the first step
            state["algorithm"] = {k: v for k, v in state["algorithm"].items() if k != "optimizer_state_dict"}
        wrong = list(ckpt.misfits(own, saved, "state"))
        if wrong:
            raise CheckpointError(
                f"{checkpoint.path}: its state is not one of this run's:\n  " + "\n  ".join(wrong[:10])
            )

    def _require_finite_parameters(self) -> None:
        for model in (self.alg.actor, self.alg.critic):
            for name, parameter in model.named_parameters():
                if not torch.isfinite(parameter).all():
                    raise HealthError(f"Parameter {name} is not finite; it is not saved. Resume the last checkpoint.")

    # --- data-parallel processes ------------------------------------------------------------------------------------

    def _any_process(self, flag: bool) -> bool:
        """Whether ``flag`` is set in any process, so that all of them stop after the same iteration."""
        if not self.is_distributed:
            return flag
        votes = torch.tensor(float(flag), device=self.device)
        torch.distributed.all_reduce(votes)
        return bool(votes > 0)

    def _configure_multi_gpu(self) -> None:
        """Join the processes torchrun started, on the CPU too, which rsl_rl itself refuses."""
        self.gpu_world_size = int(os.getenv("WORLD_SIZE", "1"))
        self.gpu_global_rank = int(os.getenv("RANK", "0"))
        self.gpu_local_rank = int(os.getenv("LOCAL_RANK", "0"))
        self.is_distributed = self.gpu_world_size > 1
        self.cfg["multi_gpu"] = None
        if not self.is_distributed:
            return
        ranks = ("global_rank", "local_rank", "world_size")
        self.cfg["multi_gpu"] = {key: getattr(self, f"gpu_{key}") for key in ranks}
        if str(self.device).startswith("cuda"):
            torch.cuda.set_device(torch.device(self.device).index or 0)
        join_processes(self.device)
