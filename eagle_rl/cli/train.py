"""``eagle train``: an experiment in, a run directory out."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from eagle_rl.config.compose import descriptions, known_names
from eagle_rl.config.load import load_experiment, to_yaml
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import ConfigError, RobotError
from eagle_rl.runners.plan import plan_stages
from eagle_rl.runners.provenance import Provenance, content_hash, slot_table_hash

from .arguments import count, require_device
from .run_directory import create_run, open_run

if TYPE_CHECKING:
    from eagle_rl.runners.team import Team

LOG_WIDTH = 160
"""Columns of tables where the output is not a terminal."""

_NEXT = """
Watch it       eagle play {run}
Measure it     eagle evaluate {run}
Curves         tensorboard --logdir {run}
Go on          eagle train --resume {run}"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eagle train",
        usage="eagle train EXPERIMENT [key=value ...] [options]\n"
        "       eagle train --resume RUN [key=value ...] [options]",
        description="Train an experiment into a new run directory, or continue one.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="experiments, or the path of a YAML file:\n"
        + "\n".join(f"  {name:<18} {what}" for name, what in descriptions("experiment").items()),
    )
    parser.add_argument(
        "words", nargs="*", metavar="EXPERIMENT key=value", help="e.g. ppo algo.gamma=0.98 robots=[h1,g1]"
    )
    parser.add_argument("--out", type=Path, default=Path("logs"), metavar="DIR", help="folder of all runs [logs]")
    parser.add_argument("--resume", type=Path, metavar="RUN", help="continue this run directory")
    parser.add_argument("--seed", type=int, metavar="N", help="the same as seed=N")
    parser.add_argument("--device", metavar="cpu|cuda", help="where the learner computes, the same as run.device=...")
    parser.add_argument("--scale", choices=known_names("scale"), help="lay cfg/scale/NAME.yaml over the experiment")
    parser.add_argument("--jobs", type=count, default=1, metavar="K", help="train K specialists side by side [1]")
    parser.add_argument("--allow-drift", action="store_true", help="resume although versions, robots or values changed")
    parser.add_argument("--show", action="store_true", help="print the resolved configuration and stop")
    return parser


def _configuration(args: argparse.Namespace) -> ExperimentCfg:
    """The experiment the command line asks for, checked."""
    experiment = args.words[0] if args.words and "=" not in args.words[0] else None
    overrides = args.words[1 if experiment else 0 :]
    overrides += [f"seed={args.seed}"] if args.seed is not None else []
    overrides += [f"run.device={args.device}"] if args.device else []
    if args.resume is None:
        if experiment is None:
            known = ", ".join(known_names("experiment"))
            raise ConfigError(f"name an experiment: {known}; or continue one with --resume RUN.")
        return load_experiment(experiment, overrides, args.scale)
    if args.scale:
        raise ConfigError("--scale: a run keeps the scale it was started with.")
    cfg = open_run(args.resume, overrides)
    if experiment not in (None, cfg.name):
        raise ConfigError(f"--resume {args.resume}: this is a run of {cfg.name!r}, not of {experiment!r}.")
    return cfg


def _provenance(cfg: ExperimentCfg) -> Provenance:
    """What a run depends on, after checking every robot's files."""
    from envs.robots.load import load_robot
    from envs.robots.slots import SLOT_NAMES

    specs = [load_robot(name) for name in cfg.robots]
    for first, second in itertools.combinations(specs, 2):
        if first.name == second.name:
            raise RobotError(
                f"robots: {first.yaml_path} and {second.yaml_path} are both called {first.name!r}; expected a name of "
                "its own for each, change `name:` in one."
            )
    robots = {s.name: content_hash([p.read_text(encoding="utf-8") for p in (s.yaml_path, s.urdf_path)]) for s in specs}
    return Provenance(config=asdict(cfg), robots=robots, slot_table_hash=slot_table_hash(SLOT_NAMES))


def main(argv: Sequence[str]) -> int:
    """Run ``eagle train``."""
    args = _parser().parse_intermixed_args(argv)
    cfg = _configuration(args)
    if args.show:
        print(to_yaml(cfg), end="")
        return 0
    if args.jobs > len(cfg.robots):
        raise ConfigError(f"--jobs {args.jobs}: at most one specialist a robot can train at a time: {len(cfg.robots)}.")
    provenance = _provenance(cfg)
    for device in (cfg.run.device, cfg.run.env_device):
        require_device(device)

    from eagle_rl.runners.team import Team

    with Team(cfg.run.device) as team:
        run_dir = team.agree(lambda: _begin(cfg, args, provenance, team.size))
        _train(cfg, run_dir, args, provenance, team)
    return 0


def _begin(cfg: ExperimentCfg, args: argparse.Namespace, provenance: Provenance, processes: int) -> Path:
    """The run's directory, once nothing speaks against going on in it, or against making it."""
    from eagle_rl.runners.records import open_plan
    from eagle_rl.runners.sources import check_sources
    from envs.mdp.layout import ObservationLayout

    stages = plan_stages(cfg, processes)
    if args.resume is not None:
        run_dir: Path = args.resume
        open_plan(run_dir, provenance, stages, resume=True, allow_drift=args.allow_drift)
        return run_dir
    layout = ObservationLayout(cfg.task.observations)
    columns = {group: layout.size(group) for group in ("history", "command", "clock", "estimate")}
    check_sources(cfg, stages, provenance, columns)
    return create_run(cfg, args.out, provenance)


def _train(cfg: ExperimentCfg, run_dir: Path, args: argparse.Namespace, provenance: Provenance, team: Team) -> None:
    from rich.console import Console

    from eagle_rl.runners.judged import judged_results
    from eagle_rl.runners.stages import run_experiment

    from .environment import make_env_factory
    from .mdp_summary import print_mdp
    from .tracking import print_tracking

    console = Console(quiet=not team.leads)
    if not console.is_terminal:
        console.width = max(console.width, LOG_WIDTH)
    print_mdp(cfg.task, console)
    console.print(f"{cfg.name}: {cfg.description}\nrun directory: {run_dir}\n", highlight=False)
    run_experiment(
        cfg,
        run_dir,
        make_env_factory(cfg.run),
        resume=args.resume is not None,
        jobs=args.jobs,
        console=console,
        provenance=provenance,
        allow_drift=args.allow_drift,
        team=team,
    )
    print_tracking(judged_results(run_dir, plan_stages(cfg)), console)
    console.print(_NEXT.format(run=run_dir), highlight=False)
