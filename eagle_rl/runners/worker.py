"""A worker: claims stages, trains and judges them, and records what came of it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.evaluation.evaluate import EvaluationResult, MakeEnv, evaluate
from eagle_rl.evaluation.protocol import finishing_ranges
from eagle_rl.evaluation.report import pooled_score
from eagle_rl.machine import own_cores
from eagle_rl.models.precision import set_up_torch
from eagle_rl.runners.checkpoint import load_checkpoint, read_manifest
from eagle_rl.runners.claims import Claim, ClaimLostError
from eagle_rl.runners.files import patiently, write_atomically
from eagle_rl.runners.judged import RESULT, training_steps
from eagle_rl.runners.plan import Stage
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.records import Record, active_stages, final_checkpoint, read_record, stage_dir, write_record
from eagle_rl.runners.team import Team
from eagle_rl.runners.training import Job, load_policy, stage_cfg, train

POLL_S = 1.0
"""Wait of a worker for whom there is nothing to do yet [s]."""


class Worker:
    """Does stages that nobody else is doing, until all are done."""

    def __init__(
        self,
        cfg: ExperimentCfg,
        stages: Sequence[Stage],
        run_dir: Path,
        make_env: MakeEnv,
        provenance: Provenance,
        team: Team,
        allow_drift: bool,
        jobs: int = 1,
    ) -> None:
        """Work on the run in ``run_dir``; see ``run_experiment``."""
        self.cfg, self.stages, self.run_dir, self.make_env = cfg, stages, run_dir, make_env
        self.provenance, self.team, self.allow_drift, self.jobs = provenance, team, allow_drift, jobs

    def work(self, console: Console | None = None) -> None:
        """Claim and run stages as they become ready."""
        set_up_torch(self.cfg.run.torch_threads or own_cores(self.jobs))
        while True:
            claimed = self._claim() if self.team.leads else None
            name = self.team.agree(lambda: claimed and claimed[0].name)  # noqa: B023 (called at once)
            if name is None:
                return
            stage = next(stage for stage in self.stages if stage.name == name)
            if claimed is None:
                train(self._job(stage, lambda: None))
            else:
                self._run(stage, claimed[1], console)

    def _claim(self) -> tuple[Stage, Claim] | None:
        """The next stage that is nobody else's, once there is one; None when all are done."""
        while True:
            records = {stage.name: read_record(self.run_dir, stage.name) for stage in self.stages}
            active = active_stages(self.stages, records, self.cfg.plan.tolerance)
            todo = [stage for stage in active if records[stage.name].state != "done"]
            if not todo:
                return None
            for stage in todo:
                if all(records[name].state == "done" for name in stage.inputs):
                    claim = patiently(partial(Claim.acquire, stage_dir(self.run_dir, stage.name)))
                    if claim is not None:
                        return stage, claim
            time.sleep(POLL_S)

    def _run(self, stage: Stage, claim: Claim, console: Console | None) -> None:
        """Bring a claimed stage to its end and record it."""
        with claim:
            if read_record(self.run_dir, stage.name).state == "done":  # by someone who let go just before
                return
            try:
                record = self._train_and_judge(self._job(stage, claim.check))
                claim.check()
            except ClaimLostError:
                if self.team.size > 1:  # the others are in the middle of it
                    raise
                return
            self._record(stage, record)
        if console is not None:
            score = "" if record.score is None else f", tracking score {record.score:.3f}"
            console.print(f"{stage.name}: done, {record.env_steps:,} environment steps{score}", highlight=False)

    def _job(self, stage: Stage, check_claim: Callable[[], None]) -> Job:
        """A stage with its inputs' checkpoints, verified."""
        inputs = {name: final_checkpoint(self.run_dir, name) for name in stage.inputs}
        cfg = stage_cfg(self.cfg, stage)
        provenance = dataclasses.replace(
            self.provenance,
            config=dataclasses.asdict(cfg),
            robots={name: self.provenance.robots.get(name, "") for name in map(self.provenance.name_of, stage.robots)},
            stage=stage.name,
            parents=tuple(read_manifest(path)["sha256"] for path in inputs.values()),
        )
        return Job(
            cfg=cfg,
            stage=stage,
            folder=stage_dir(self.run_dir, stage.name),
            init=None if stage.init is None else inputs[stage.init],
            teachers=tuple(inputs[name] for name in stage.teachers),
            start=None if stage.start is None else inputs[stage.start],
            base=None if stage.base is None else inputs[stage.base],
            critic=None if stage.critic is None else inputs[stage.critic],
            make_env=self.make_env,
            provenance=provenance,
            check_claim=check_claim,
            rank=self.team.rank,
            allow_drift=self.allow_drift,
        )

    def _train_and_judge(self, job: Job) -> Record:
        """The record of a stage that is done, all but written."""
        inputs = dict(zip(job.stage.inputs, job.provenance.parents, strict=True))
        self._record(job.stage, Record(state="training", inputs=inputs))
        checkpoint = train(job)
        spent = load_checkpoint(checkpoint).state["runner"]
        root = job.stage.kind == "root"
        record = Record(
            state="judging",
            inputs=inputs,
            env_steps=0 if root else spent["env_steps"],
            wall_seconds=0.0 if root else spent["wall_time"],
            checkpoint=checkpoint.relative_to(self.run_dir).as_posix(),
            sha256=read_manifest(checkpoint)["sha256"],
        )
        self._record(job.stage, record)
        return dataclasses.replace(record, state="done", score=self._judge(job, checkpoint))

    def _record(self, stage: Stage, record: Record) -> None:
        patiently(lambda: write_record(self.run_dir, stage.name, record))

    def _judge(self, job: Job, checkpoint: Path) -> float | None:
        """Evaluate the stage's policy on the fixed seed and keep the result; the pooled score."""
        cfg = job.cfg
        if cfg.plan.judge_envs_per_robot == 0:
            return None
        ev = dataclasses.replace(cfg.evaluation, num_envs_per_robot=cfg.plan.judge_envs_per_robot)
        robots = evaluate(load_policy(job, checkpoint), self.make_env, cfg.robots, cfg.task, ev)
        result = EvaluationResult(
            checkpoint=read_manifest(checkpoint)["sha256"],
            protocol=ev,
            robots=robots,
            seed=cfg.seed,
            env_steps=training_steps(checkpoint),
            ranges=finishing_ranges(cfg.task.commands),
        )
        patiently(lambda: write_atomically(job.folder / RESULT, result.to_json().encode()))
        return pooled_score(robots, ev, result.ranges)
