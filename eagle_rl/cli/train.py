"""``eagle train``: an experiment in, a run directory out."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eagle_rl.config.compose import known_names
from eagle_rl.config.load import config_hash, load_experiment, to_yaml
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import ConfigError
from eagle_rl.runners.provenance import Provenance, content_hash, slot_table_hash

from .provenance import provenance
from .run_directory import check_drift, create_run, open_run

if TYPE_CHECKING:
    from rich.console import Console

    from eagle_rl.runners.team import Team


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eagle train",
        usage="eagle train EXPERIMENT [key=value ...] [options]\n"
        "       eagle train --resume RUN [key=value ...] [options]",
        description="Train an experiment into a new run directory, or continue one.",
        epilog=f"Experiments: {', '.join(known_names('experiment'))}, or the path of a YAML file.",
    )
    parser.add_argument(
        "words", nargs="*", metavar="EXPERIMENT key=value", help="e.g. ppo algo.gamma=0.98 robots=[h1,g1]"
    )
    parser.add_argument("--out", type=Path, default=Path("logs"), metavar="DIR", help="folder of all runs [logs]")
    parser.add_argument("--resume", type=Path, metavar="RUN", help="continue this run directory")
    parser.add_argument("--seed", type=int, metavar="N", help="the same as seed=N")
    parser.add_argument("--device", metavar="cpu|cuda", help="where the learner computes, the same as run.device=...")
    parser.add_argument("--scale", choices=known_names("scale"), help="lay cfg/scale/NAME.yaml over the experiment")
    parser.add_argument("--jobs", type=int, default=1, metavar="K", help="train K specialists side by side [1]")
    parser.add_argument("--allow-drift", action="store_true", help="resume although versions, robots or values changed")
    parser.add_argument("--show", action="store_true", help="print the resolved configuration and stop")
    return parser


@dataclass(frozen=True)
class _Request:
    """What the command line asks for, checked."""

    cfg: ExperimentCfg
    changes: list[str]
    """Keys on which a resumed run's configuration would change."""


def _request(args: argparse.Namespace) -> _Request:
    experiment = args.words[0] if args.words and "=" not in args.words[0] else None
    overrides = args.words[1 if experiment else 0 :]
    overrides += [f"seed={args.seed}"] if args.seed is not None else []
    overrides += [f"run.device={args.device}"] if args.device else []
    if args.resume is not None:
        if args.scale:
            raise ConfigError("--scale: a run keeps the scale it was started with.")
        cfg, changes = open_run(args.resume, overrides)
        if experiment not in (None, cfg.name):
            raise ConfigError(f"--resume {args.resume}: this is a run of {cfg.name!r}, not of {experiment!r}.")
        return _Request(cfg, changes)
    if experiment is None:
        raise ConfigError(
            f"name an experiment: {', '.join(known_names('experiment'))}; or continue one with --resume RUN."
        )
    return _Request(load_experiment(experiment, overrides, args.scale), [])


def _record(cfg: ExperimentCfg) -> dict[str, Any]:
    """Provenance of a run, after checking every robot's files."""
    from envs.robots.load import load_robot

    specs = [load_robot(name) for name in cfg.robots]
    return provenance(cfg.seed, {s.name: (s.yaml_path, s.urdf_path) for s in specs}, config_hash(cfg))


def _prepare_torch(cfg: ExperimentCfg) -> None:
    import torch

    torch.set_num_threads(cfg.run.torch_threads)
    if cfg.run.device != "cpu" and not torch.cuda.is_available():
        raise ConfigError(f"run.device: {cfg.run.device} is not available here: torch finds no CUDA device. Use cpu.")


def main(argv: Sequence[str]) -> int:
    """Run ``eagle train``."""
    args = _parser().parse_intermixed_args(argv)
    request = _request(args)
    cfg = request.cfg
    if args.show:
        print(to_yaml(cfg), end="")
        return 0
    record = _record(cfg)
    if args.resume is not None:
        check_drift(args.resume, request.changes, record, args.allow_drift)
    _prepare_torch(cfg)

    from eagle_rl.runners.team import Team

    team = Team(cfg.run.device)
    run_dir = args.resume or team.agree(lambda: create_run(cfg, args.out, record))
    return _train(cfg, run_dir, args, record, team)


def _identity(record: dict[str, Any]) -> Provenance:
    """What checkpoints of the run belong to."""
    from envs.robots.slots import SLOT_NAMES

    robots = {name: content_hash(files) for name, files in record["robots"].items()}
    return Provenance(robots=robots, slot_table_hash=slot_table_hash(SLOT_NAMES))


def _train(cfg: ExperimentCfg, run_dir: Path, args: argparse.Namespace, record: dict[str, Any], team: Team) -> int:
    from rich.console import Console

    from eagle_rl.runners.stages import run_experiment

    from .environment import make_env_factory
    from .mdp_summary import print_mdp

    console = Console(quiet=not team.leads)
    print_mdp(cfg.task, console)
    console.print(f"{cfg.name}: {cfg.description}\nrun directory: {run_dir}", highlight=False)
    run_experiment(
        cfg,
        run_dir,
        make_env_factory(cfg.run),
        resume=args.resume is not None,
        jobs=args.jobs,
        console=console,
        provenance=_identity(record),
        allow_drift=args.allow_drift,
        team=team,
    )
    _print_scores(run_dir, console)
    console.print(
        f"\nWatch it:     eagle play {run_dir}\nMeasure it:   eagle evaluate {run_dir}\n"
        f"Curves:       tensorboard --logdir {run_dir}\nGo on:        eagle train --resume {run_dir}",
        highlight=False,
    )
    return 0


def _print_scores(run_dir: Path, console: Console) -> None:
    """The tracking table of the stages that were judged."""
    from rich.markdown import Markdown

    from eagle_rl.evaluation.render import to_markdown
    from eagle_rl.evaluation.report import tracking_table
    from eagle_rl.runners.judged import judged_results

    results = judged_results(run_dir)
    if results:
        console.print(Markdown(to_markdown(tracking_table(results, paper={}))))
