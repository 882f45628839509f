"""Algorithm 1 as a resumable stage machine over a shared folder.

Every worker, whether the only one, one of ``--jobs`` or one on another machine, runs the same loop: claim a stage whose
inputs are done, train it, judge it, record it. What is on disk is all there is to know, so a run continues from
wherever it stopped, also inside a stage.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import ConfigError, EagleError
from eagle_rl.evaluation.evaluate import MakeEnv
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.records import Record, active_stages, final_checkpoint, open_plan, read_record
from eagle_rl.runners.sources import check_sources
from eagle_rl.runners.team import Team
from eagle_rl.runners.worker import Worker


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
    team: Team | None = None,
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
        team: the data-parallel processes this one belongs to.
    """
    team = team or Team(cfg.run.device)
    if jobs > 1 and team.size > 1:
        raise ConfigError(f"--jobs {jobs}: each of {team.size} data-parallel processes trains the same stage; use one.")
    now = dataclasses.replace(provenance or Provenance(), config=dataclasses.asdict(cfg))
    stages = plan_stages(cfg, team.size)
    if not resume:
        check_sources(cfg, stages, now)
    provenance = team.agree(lambda: open_plan(run_dir, now, stages, resume=resume, allow_drift=allow_drift))
    allow_drift |= provenance.drifted  # its checkpoints may be from before
    worker = Worker(cfg, stages, run_dir, make_env, provenance, team, allow_drift, jobs)
    spawn = multiprocessing.get_context("spawn")
    helpers = [spawn.Process(target=_help, args=(worker,)) for _ in range(jobs - 1)]
    for helper in helpers:
        helper.start()
    try:
        worker.work(console or Console(stderr=True))
    except BaseException:
        for helper in helpers:
            helper.terminate()  # a polite SIGTERM, which adds nothing to a Ctrl-C: it saves, then stops
        raise
    finally:
        for helper in helpers:
            helper.join()
    records = {stage.name: read_record(run_dir, stage.name) for stage in stages}
    active = active_stages(stages, records, cfg.plan.tolerance)
    generalist = [stage for stage in active if not stage.specialised][-1]
    return RunResult(run_dir=run_dir, generalist=final_checkpoint(run_dir, generalist.name), records=records)


def _help(worker: Worker) -> None:
    """Work in a process of its own; what goes wrong is found, and told, by the main process too."""
    with contextlib.suppress(EagleError, KeyboardInterrupt):
        worker.work()
