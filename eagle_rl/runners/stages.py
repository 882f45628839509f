"""Algorithm 1 as a resumable stage machine over a shared folder.

Every worker, whether the only one, one of ``--jobs`` or one on another machine, runs the same loop: claim a stage whose
inputs are done, train it, judge it, record it. What is on disk is all there is to know, so a run continues from
wherever it stopped, also inside a stage.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console

from eagle_rl.config.schema import EvaluationCfg, ExperimentCfg
from eagle_rl.errors import EagleError
from eagle_rl.evaluation.evaluate import EvaluationResult, evaluate
from eagle_rl.evaluation.report import pooled_score
from eagle_rl.runners.checkpoint import load_actor, load_checkpoint, read_manifest
from eagle_rl.runners.claims import Claim, ClaimLostError
from eagle_rl.runners.plan import Stage, plan_stages
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.records import (
    Record,
    active_stages,
    final_checkpoint,
    open_plan,
    read_record,
    stage_dir,
    write_record,
)
from eagle_rl.runners.training import Job, MakeEnv, stage_cfg, train

POLL_S = 1.0
"""Wait of a worker for whom there is nothing to do yet [s]."""


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """What a finished run leaves behind."""

    run_dir: Path
    generalist: Path
    """Final checkpoint of the last generalist."""
    records: dict[str, Record]
    """By stage name, in the order of the plan."""

    @property
    def env_steps(self) -> int:
        """Environment steps of all stages."""
        return sum(record.env_steps for record in self.records.values())


def run_experiment(
    cfg: ExperimentCfg,
    run_dir: Path,
    make_env: MakeEnv,
    resume: bool = False,
    jobs: int = 1,
    console: Console | None = None,
    provenance: Provenance | None = None,
    allow_drift: bool = False,
) -> RunResult:
    """Run all stages of an experiment.

    Args:
        cfg: the experiment.
        run_dir: the run's folder; several machines may share it, each with a call of its own.
        make_env: builds the environments of training and of evaluation; picklable if ``jobs`` > 1.
        resume: continue, or join, the run that ``run_dir`` holds.
        jobs: worker processes; the specialists of a round train side by side.
        console: where stages are announced.
        provenance: robots' and slot table's identity, kept with every checkpoint.
        allow_drift: resume although the configuration or versions have changed.
    """
    provenance = dataclasses.replace(provenance or Provenance(), config=dataclasses.asdict(cfg))
    open_plan(run_dir, provenance, plan_stages(cfg), resume=resume, allow_drift=allow_drift)
    worker = Worker(cfg, run_dir, make_env, provenance, allow_drift)
    spawn = multiprocessing.get_context("spawn")
    helpers = [spawn.Process(target=_help, args=(worker,)) for _ in range(jobs - 1)]
    for helper in helpers:
        helper.start()
    try:
        worker.work(console or Console(stderr=True))
    except BaseException:
        for helper in helpers:
            helper.terminate()  # a polite SIGTERM: it saves, then stops
        raise
    finally:
        for helper in helpers:
            helper.join()
    return worker.result()


def _help(worker: Worker) -> None:
    """Work in a process of its own; what goes wrong is found, and told, by the main process too."""
    with contextlib.suppress(EagleError, KeyboardInterrupt):
        worker.work()


class Worker:
    """Does stages that nobody else is doing, until all are done."""

    def __init__(
        self, cfg: ExperimentCfg, run_dir: Path, make_env: MakeEnv, provenance: Provenance, allow_drift: bool
    ) -> None:
        """Work on the run in ``run_dir``; see :func:`run_experiment`."""
        self.cfg, self.run_dir, self.make_env = cfg, run_dir, make_env
        self.provenance, self.allow_drift = provenance, allow_drift
        self.stages = plan_stages(cfg)

    def work(self, console: Console | None = None) -> None:
        """Claim and run stages as they become ready."""
        torch.set_num_threads(self.cfg.run.torch_threads)
        while True:
            records = self._records()
            active = active_stages(self.stages, records, self.cfg.plan.tolerance)
            todo = [stage for stage in active if records[stage.name].state != "done"]
            if not todo:
                return
            ready = (s for s in todo if all(records[name].state == "done" for name in s.inputs))
            if not any(self._claim_and_run(stage, console) for stage in ready):
                time.sleep(POLL_S)

    def result(self) -> RunResult:
        """What the run left, once all stages are done."""
        records = self._records()
        active = active_stages(self.stages, records, self.cfg.plan.tolerance)
        generalist = [stage for stage in active if stage.kind != "specialist"][-1]
        return RunResult(
            run_dir=self.run_dir, generalist=final_checkpoint(self.run_dir, generalist.name), records=records
        )

    def _records(self) -> dict[str, Record]:
        return {stage.name: read_record(self.run_dir, stage.name) for stage in self.stages}

    def _claim_and_run(self, stage: Stage, console: Console | None) -> bool:
        """Run a stage unless someone else does; whether anything was done."""
        claim = Claim.acquire(stage_dir(self.run_dir, stage.name))
        if claim is None:
            return False
        with claim:
            if read_record(self.run_dir, stage.name).state == "done":
                return True
            try:
                record = self._run(stage, claim)
                claim.check()
            except ClaimLostError:
                return True
            write_record(self.run_dir, stage.name, record)
        if console is not None:
            score = "" if record.score is None else f", tracking score {record.score:.3f}"
            console.print(f"{stage.name}: done, {record.env_steps:,} environment steps{score}", highlight=False)
        return True

    def _run(self, stage: Stage, claim: Claim) -> Record:
        """Train and judge a stage; the record of it done."""
        inputs = {name: final_checkpoint(self.run_dir, name) for name in stage.inputs}
        hashes = {name: read_manifest(path)["sha256"] for name, path in inputs.items()}
        write_record(self.run_dir, stage.name, Record(state="training", inputs=hashes))
        cfg = stage_cfg(self.cfg, stage)
        job = Job(
            cfg=cfg,
            stage=stage,
            folder=stage_dir(self.run_dir, stage.name),
            init=None if stage.init is None else inputs[stage.init],
            teachers=tuple(inputs[name] for name in stage.teachers),
            make_env=self.make_env,
            provenance=self._provenance(stage, cfg, hashes),
            check_claim=claim.check,
            allow_drift=self.allow_drift,
        )
        checkpoint = train(job)
        spent = load_checkpoint(checkpoint).state["runner"]
        root = stage.kind == "root"
        record = Record(
            state="judging",
            inputs=hashes,
            env_steps=0 if root else spent["env_steps"],
            wall_seconds=0.0 if root else spent["wall_time"],
            checkpoint=checkpoint.relative_to(self.run_dir).as_posix(),
            sha256=read_manifest(checkpoint)["sha256"],
        )
        write_record(self.run_dir, stage.name, record)
        return dataclasses.replace(record, state="done", score=self._judge(job, checkpoint))

    def _provenance(self, stage: Stage, cfg: ExperimentCfg, hashes: dict[str, str]) -> Provenance:
        """Identity of a stage."""
        robots = {name: self.provenance.robots.get(name, "") for name in stage.robots}
        return dataclasses.replace(
            self.provenance,
            config=dataclasses.asdict(cfg),
            robots=robots,
            stage=stage.name,
            parents=tuple(hashes.values()),
        )

    def _judge(self, job: Job, checkpoint: Path) -> float | None:
        """Evaluate the stage's policy on the fixed seed and keep the result; the pooled score."""
        if job.cfg.plan.judge_envs_per_robot == 0:
            return None
        ev = dataclasses.replace(job.cfg.evaluation, num_envs_per_robot=job.cfg.plan.judge_envs_per_robot)
        result = judge(checkpoint, job.cfg, ev, self.make_env)
        (job.folder / "evaluation.json").write_text(result.to_json(), encoding="utf-8")
        return pooled_score(result.robots)


def judge(checkpoint: Path, cfg: ExperimentCfg, ev: EvaluationCfg, make_env: MakeEnv) -> EvaluationResult:
    """Evaluate a checkpoint on the robots and in the task of ``cfg``."""
    actor, manifest = load_actor(checkpoint, cfg.run.device)
    robots = evaluate(actor, make_env, cfg.robots, cfg.task, ev)
    return EvaluationResult(checkpoint=manifest["sha256"], protocol=ev, robots=robots, seed=cfg.seed)
