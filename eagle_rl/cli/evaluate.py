"""``eagle evaluate``: tracking errors and survival of checkpoints, as the paper's table."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from eagle_rl.config.schema import EvaluationCfg, ExperimentCfg, Range
from eagle_rl.errors import ConfigError

from .arguments import count, device, require_folder, seconds
from .policy import Policy, chosen_robots, load_policy

if TYPE_CHECKING:
    from rich.console import Console

    from eagle_rl.evaluation.evaluate import EvaluationResult
    from eagle_rl.evaluation.report import Table

METHODS = {
    "ppo": "PPO",
    "ppo_no_eo": "PPO w/o EO",
    "compass": "COMPASS",
    "kickstarting": "Kickstarting",
    "eagle": "EAGLE",
    "eagle_id": "EAGLE w/ ID",
    "single": "single-robot PPO",
    "published": "PPO",
    "fork_ppo": "PPO continued",
    "fork_compass": "COMPASS",
    "fork_kickstarting": "Kickstarting",
    "fork_eagle": "EAGLE",
    "fork_search": "EAGLE, searched",
    "fork_correct": "EAGLE, corrected",
    "fork_eagle_id": "EAGLE w/ ID",
}
"""The paper's name for each of its experiments."""

QUICK_ENVS = 32
"""Environments a robot for a first look."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eagle evaluate",
        description="Tracking errors and survival of checkpoints. A repeated name is another seed of the same method.",
        epilog="Example: eagle evaluate PPO=logs/ppo/RUN EAGLE=logs/eagle/RUN1 EAGLE=logs/eagle/RUN2 --out results",
    )
    parser.add_argument("checkpoints", nargs="+", metavar="[NAME=]CKPT", help="checkpoint, stage, run, or result .json")
    parser.add_argument("--robots", metavar="A,B", help="robots to judge on, or all [those it was trained on]")
    parser.add_argument("--envs", type=count, metavar="N", help="environments per robot [the experiment's, mostly 256]")
    parser.add_argument("--steps", type=count, metavar="N", help="control steps [the experiment's, 1000 in the paper]")
    parser.add_argument(
        "--protocol",
        choices=("single", "joint", "upright", "standing"),
        help="draw one command, all five, the three velocities, or posture",
    )
    parser.add_argument(
        "--resample",
        type=seconds,
        metavar="S",
        help="redraw commands every S seconds, 0 never; standing: walk by turns",
    )
    parser.add_argument("--seed", type=int, metavar="N", help="seed of commands and randomization")
    parser.add_argument("--randomize", action="store_true", help="randomized dynamics, with pushes")
    parser.add_argument("--noise", action="store_true", help="sensor noise")
    parser.add_argument(
        "--subset", default="all", metavar="NAME", help="all, settled, standing, walking, squatting, leaning"
    )
    parser.add_argument(
        "--falls", choices=("charged", "errors"), default="charged", help="charge |c_d| after a fall, or stop"
    )
    parser.add_argument(
        "--device", type=device, default="cpu", metavar="cpu|cuda", help="where the policy computes [cpu]"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="write results, table.{md,csv,tex,json} and any falls.md here"
    )
    return parser


@dataclass(frozen=True)
class _Trial:
    """A policy to judge, and how."""

    policy: Policy
    protocol: EvaluationCfg
    robots: tuple[str, ...]
    ranges: tuple[Range, ...]
    """Of the commands."""


def _split(word: str) -> tuple[str | None, Path]:
    """``NAME=PATH`` or ``PATH``."""
    name, equals, path = word.partition("=")
    return (name, Path(path)) if equals else (None, Path(word))


def _method(cfg: ExperimentCfg) -> str:
    """The paper's name for an experiment, or its own."""
    if cfg.plan.method == "ppo" and cfg.plan.root is not None:
        return "PPO continued"
    return METHODS.get("single" if len(cfg.robots) == 1 and cfg.plan.method == "ppo" else cfg.name, cfg.name)


def _protocol(ev: EvaluationCfg, args: argparse.Namespace) -> EvaluationCfg:
    """The experiment's protocol with the command line's changes."""
    asked = {
        "num_envs_per_robot": args.envs,
        "num_steps": args.steps,
        "protocol": args.protocol,
        "resampling_time_s": args.resample,
        "seed": args.seed,
        "randomization": args.randomize or None,
        "noise": args.noise or None,
    }
    return dataclasses.replace(ev, **{key: value for key, value in asked.items() if value is not None})


def _find(word: str, args: argparse.Namespace) -> tuple[str, EvaluationResult | _Trial]:
    """The method a word of the command line names, and its stored result or the policy that is to be judged."""
    from eagle_rl.evaluation.evaluate import EvaluationResult
    from eagle_rl.evaluation.protocol import finishing_ranges

    name, path = _split(word)
    if _is_result(path):
        return name or path.stem, EvaluationResult.read(path)
    policy = load_policy(path, args.device)
    ev, robots = _protocol(policy.cfg.evaluation, args), chosen_robots(args.robots, policy.cfg)
    return name or _method(policy.cfg), _Trial(policy, ev, robots, finishing_ranges(policy.cfg.task.commands))


def announcement(name: str, ev: EvaluationCfg, robots: Sequence[str]) -> str:
    """What is going to be simulated, and how to have it sooner."""
    size = f"{len(robots)} robot{'s' * (len(robots) > 1)} x {ev.num_envs_per_robot} environments x {ev.num_steps} steps"
    hint = f" (--envs {QUICK_ENVS} is quicker)" if ev.num_envs_per_robot > QUICK_ENVS else ""
    return f"{name}: judging {size}{hint}"


def _judge(name: str, trial: _Trial, console: Console) -> EvaluationResult:
    """Evaluate one policy, with progress."""
    from rich.progress import Progress

    from eagle_rl.evaluation.evaluate import EvaluationResult, evaluate

    from .environment import make_env_factory

    policy, ev, robots = trial.policy, trial.protocol, trial.robots
    cfg = policy.cfg
    make_env = make_env_factory(cfg.run)
    console.print(announcement(name, ev, robots), highlight=False, markup=False, soft_wrap=True)
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task(name, total=len(robots) * ev.num_envs_per_robot * ev.num_steps)
        scores = evaluate(policy.act, make_env, robots, cfg.task, ev, on_step=lambda n: progress.advance(bar, n))
    return EvaluationResult(
        checkpoint=policy.sha256,
        protocol=ev,
        robots=scores,
        seed=cfg.seed,
        env_steps=policy.env_steps,
        unseen=tuple(robot for robot in robots if not policy.knows(robot)),
        ranges=trial.ranges,
    )


def main(argv: Sequence[str]) -> int:
    """Run ``eagle evaluate``."""
    args = _parser().parse_args(argv)

    from rich.console import Console

    from eagle_rl.evaluation.falls import falls_table
    from eagle_rl.evaluation.metrics import SUBSETS
    from eagle_rl.evaluation.render import to_markdown
    from eagle_rl.evaluation.report import common_protocol, common_ranges, falls_of, tracking_table

    if args.subset not in SUBSETS:
        raise ConfigError(f"--subset: got {args.subset!r}, expected one of {', '.join(SUBSETS)}.")
    if args.out is not None:
        require_folder(args.out)
    console = Console(stderr=True)
    found = [_find(word, args) for word in args.checkpoints]
    common_protocol(each.protocol for _, each in found)  # before anything is judged, which takes minutes
    common_ranges(each.ranges for _, each in found)
    results: dict[str, list[EvaluationResult]] = {}
    for method, each in found:
        result = _judge(method, each, console) if isinstance(each, _Trial) else each
        results.setdefault(method, []).append(result)
        if args.out is not None:
            _store(args.out, method, result)
    table = tracking_table(results, args.subset, args.falls)
    falls = falls_table(falls_of(results))
    print(to_markdown(table))
    if falls:
        print(falls)
    if args.out is not None:
        _write(args.out, table, falls)
    return 0


def _is_result(path: Path) -> bool:
    """Whether a path is a stored result, not the manifest of a policy."""
    from eagle_rl.runners.published import SUFFIX

    if path.suffix != ".json" or not path.exists():
        return False
    return not (path.name.startswith("model_") or path.with_suffix(SUFFIX).exists())


def _store(folder: Path, method: str, result: EvaluationResult) -> None:
    """Keep a result, so that nothing that happens later costs it."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{_slug(method)}_seed{result.seed}_{result.checkpoint[:8]}.json"
    file.write_text(result.to_json(), encoding="utf-8")


def _write(folder: Path, table: Table, falls: str) -> None:
    """Write the table in every format, and how robots fell."""
    from eagle_rl.evaluation.render import FORMATS

    for suffix, write in FORMATS.items():
        (folder / f"table.{suffix}").write_text(write(table), encoding="utf-8")
    story = folder / "falls.md"
    if falls:
        story.write_text(falls, encoding="utf-8")
    else:
        story.unlink(missing_ok=True)


def _slug(name: str) -> str:
    """A name fit for a file."""
    return "".join(c if c.isalnum() else "_" for c in name).strip("_").lower()
