"""One stage of the plan, trained by the on-policy runner to its last iteration, wherever it stopped before."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from rsl_rl.env import VecEnv

from eagle_rl.algorithms.specialists import SpecialistBank
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.evaluation.evaluate import MakeEnv, Policy
from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.models.correction import CorrectedPolicy
from eagle_rl.models.sides import MirrorMap
from eagle_rl.runners.checkpoint import (
    latest_checkpoint,
    load_actor,
    load_checkpoint,
    load_correction,
    read_manifest,
    save_checkpoint,
)
from eagle_rl.runners.compass import DemonstrationEnv, ResidualBank, ResidualEnv, ResidualPolicy, begin_residual
from eagle_rl.runners.compiling import compile_where_it_pays
from eagle_rl.runners.correcting import CorrectionRunner
from eagle_rl.runners.files import patiently
from eagle_rl.runners.on_policy import EagleRunner, make_train_cfg
from eagle_rl.runners.plan import Stage, stage_num_envs, warm_task
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.root import take_root
from eagle_rl.runners.searching import SearchRunner
from eagle_rl.runners.teacher import take_teacher


@dataclass(frozen=True, kw_only=True)
class Job:
    """A stage with everything resolved that its training needs."""

    cfg: ExperimentCfg
    """The experiment with this stage's robots and task."""
    stage: Stage
    folder: Path
    """Where checkpoints and logs go."""
    init: Path | None
    """Checkpoint whose weights to start from."""
    teachers: tuple[Path, ...]
    """Final checkpoint of each robot's specialist."""
    start: Path | None
    """Checkpoint whose weights those of ``init`` are averaged with."""
    base: Path | None
    """Checkpoint of the policy whose actions the specialists' are added to."""
    critic: Path | None
    """Checkpoint whose critic and learning rate a residual begins with."""
    make_env: MakeEnv
    provenance: Provenance
    check_claim: Callable[[], None]
    """Raises once another worker has taken the stage over."""
    rank: int = 0
    """Among the data-parallel processes."""
    allow_drift: bool = False


def stage_cfg(cfg: ExperimentCfg, stage: Stage) -> ExperimentCfg:
    """The experiment as one stage sees it: its robots, its task and, where nothing is imitated, PPO's loss."""
    task = warm_task(cfg.task) if stage.warm else cfg.task
    algo = cfg.algo
    if stage.demonstrations:
        algo = dataclasses.replace(algo, use_ppo_loss=False, kickstart_coef=1.0, kickstart_decay=0.0)
    elif stage.imitation is None:
        algo = dataclasses.replace(algo, use_ppo_loss=True)
    return dataclasses.replace(cfg, robots=stage.robots, num_envs=stage_num_envs(cfg, stage.kind), task=task, algo=algo)


def train(job: Job) -> Path:
    """Train to the stage's last iteration, continuing what the folder holds; the final checkpoint."""
    checkpoints = job.folder / "checkpoints"
    latest = latest_checkpoint(checkpoints)
    if latest is not None and read_manifest(latest)["stage_end"]:
        return latest
    if job.stage.kind == "root":
        return take_root(job.cfg, checkpoints, job.provenance, lambda: _mirror(job), first=job.rank == 0)
    if job.stage.kind == "teacher":
        return take_teacher(job.cfg, job.stage, checkpoints, job.provenance, lambda: _columns(job), first=job.rank == 0)
    if job.stage.kind == "search":
        return _search(job, latest)
    if job.stage.kind == "correct":
        return _correct(job)
    if job.stage.kind == "average":
        return _average(job)
    runner = _make_runner(job)
    if latest is not None:
        runner.load(latest, allow_drift=job.allow_drift)
    elif job.init is not None:
        runner.load_weights(job.init)
    left = job.stage.iterations - runner.current_learning_iteration
    final = runner.learn(left, on_iteration=lambda iteration: job.check_claim())
    return final or checkpoints / f"model_{job.stage.iterations}.pt"


def _mirror(job: Job) -> MirrorMap:
    """Left and right exchanged in what the environment shows and takes."""
    mirror: MirrorMap = job.make_env(job.cfg.robots, len(job.cfg.robots), job.cfg.task, job.stage.seed).mirror
    return mirror


def _columns(job: Job) -> dict[str, int]:
    """Columns of the observation groups."""
    obs = job.make_env(job.cfg.robots, len(job.cfg.robots), job.cfg.task, job.stage.seed).get_observations()
    return {group: obs[group].shape[1] for group in ACTOR_INPUTS}


def _search(job: Job, latest: Path | None) -> Path:
    """Search to the stage's last generation; only the first of several processes does, the others wait."""
    if job.rank == 0:
        assert job.init is not None, "a search starts from a policy"
        runner = SearchRunner(job.cfg, job.stage, job.init, job.folder, job.make_env, job.provenance)
        if latest is not None:
            runner.load(latest)
        return runner.run(job.check_claim)
    return job.folder / "checkpoints" / f"model_{job.stage.iterations}.pt"


def _correct(job: Job) -> Path:
    """Correct a policy; only the first of several processes does, the others wait."""
    if job.rank == 0:
        assert job.init is not None, "a correction is one of a policy"
        return CorrectionRunner(job.cfg, job.stage, job.init, job.folder, job.make_env, job.provenance).run(
            job.check_claim
        )
    return job.folder / "checkpoints" / f"model_{job.stage.iterations}.pt"


def _average(job: Job) -> Path:
    """Average a distilled policy with the one its round started from; the rest of its learner stays.

    Both are near each other, so that what lies between acts like something between (Wortsman et al. 2022, "Robust
    fine-tuning of zero-shot models").
    """
    checkpoints = job.folder / "checkpoints"
    if job.rank == 0:
        assert job.init is not None, "an average has an end"
        assert job.start is not None, "and a start"
        end, start = (load_checkpoint(path).state for path in (job.init, job.start))
        end.pop("processes", None)  # its environments, in which nobody goes on: an average is not trained
        learner, weights = end["algorithm"], start["algorithm"]["actor_state_dict"]
        share = job.cfg.plan.start_share
        actor = {name: torch.lerp(x, weights[name], share) for name, x in learner["actor_state_dict"].items()}
        counters = {"next_iteration": 0, "env_steps": 0, "wall_time": 0.0}
        state = end | {"algorithm": learner | {"actor_state_dict": actor}, "runner": counters}
        patiently(lambda: save_checkpoint(checkpoints, state, job.provenance, iteration=0, env_steps=0, stage_end=True))
    return checkpoints / "model_0.pt"


def _make_runner(job: Job) -> EagleRunner:
    """The runner of a stage, its specialists loaded."""
    cfg, stage = job.cfg, job.stage
    torch.manual_seed(stage.seed + job.rank)  # demonstrators draw their first step before the learner seeds its own
    simulation: VecEnv = job.make_env(stage.robots, cfg.num_envs, cfg.task, stage.seed + job.rank)
    env = simulation
    acting_base = _load(job.base, cfg.run.env_device)
    history = cfg.task.observations.history_length
    if stage.demonstrations:
        actors = _teachers(job, acting_base, cfg.run.env_device)
        assert actors is not None, "a stage of demonstrations has specialists"
        frame_dim = env.get_observations()["history"].shape[1] // history
        env = DemonstrationEnv(env, actors, frame_dim if stage.world_model else 0)
    elif acting_base is not None:
        env = ResidualEnv(env, acting_base)
    base = _load(job.base, cfg.run.device)
    bank = _teachers(job, base, cfg.run.device)
    train_cfg = make_train_cfg(cfg.algo, cfg.run, history_length=history, seed=stage.seed)
    runner = EagleRunner(env, train_cfg, job.folder, cfg.run.device, job.provenance)
    compile_where_it_pays(simulation, runner.alg, cfg.run, stage.env_steps)
    if bank is not None and stage.imitation is not None:
        runner.alg.imitate(bank, stage.imitation)
        runner.alg.imitation_updates = stage.iterations
    if base is not None and job.critic is not None:
        begin_residual(runner.alg.actor, base)
        learner = load_checkpoint(job.critic)
        runner.require_same_shapes(learner, ("critic",))
        runner.alg.adopt(learner.state["algorithm"])
    return runner


def _load(path: Path | None, device: str) -> EagleActor | None:
    return None if path is None else load_actor(path, device)[0]


def _teachers(job: Job, base: EagleActor | None, device: str) -> SpecialistBank | None:
    """The specialists of a stage that has any."""
    actors = [load_actor(path, device)[0] for path in job.teachers]
    if not actors:
        return None
    if base is not None:
        return ResidualBank(base, actors)
    return SpecialistBank(actors, [load_correction(path, device) for path in job.teachers])


def load_policy(job: Job, checkpoint: Path) -> Policy:
    """The deterministic policy a stage ended with, where the environments are."""
    device = job.cfg.run.env_device
    actor = load_actor(checkpoint, device)[0]
    base = _load(job.base, device) if job.stage.kind == "residual" else None
    if base is not None:
        return ResidualPolicy(base, actor)
    correction = load_correction(checkpoint, device)
    return actor if correction is None else CorrectedPolicy(actor, correction)
