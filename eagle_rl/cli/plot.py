"""``eagle plot``: figures from runs and checkpoints, as PNG and PDF."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from eagle_rl.errors import ConfigError

from .arguments import count, device, require_folder
from .policy import chosen_robots, load_policy

if TYPE_CHECKING:
    from eagle_rl.evaluation.plots import Figure

FIGURES = {
    "curves": "learning curves per robot of a run's stages",
    "rounds": "tracking errors over rounds, specialists and generalists marked",
    "latents": "t-SNE of e(s_t) of walking robots, silhouette score and linear probe, one panel per checkpoint",
    "response": "commanded and measured traces of all five commands",
    "robustness": "survival and errors under pushes, low friction, payload, latency and other masses",
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eagle plot",
        description="Draw a figure as PNG and PDF.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="figures:\n" + "\n".join(f"  {name:<11} {what}" for name, what in FIGURES.items()),
    )
    parser.add_argument("figure", choices=FIGURES, metavar="FIGURE", help=", ".join(FIGURES))
    parser.add_argument(
        "paths", nargs="+", metavar="[NAME=]PATH", help="runs (curves, rounds) or checkpoints (the rest)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("figures"), metavar="DIR", help="folder of the figures [figures]"
    )
    parser.add_argument("--robots", metavar="A,B", help="robots to show, or all [those it was trained on]")
    parser.add_argument(
        "--device", type=device, default="cpu", metavar="cpu|cuda", help="where the policy computes [cpu]"
    )
    parser.add_argument("--envs", type=count, default=16, metavar="N", help="environments per robot [16]")
    parser.add_argument("--steps", type=count, default=500, metavar="N", help="control steps of robustness runs [500]")
    parser.add_argument("--smooth", type=count, default=10, metavar="N", help="iterations averaged in curves [10]")
    return parser


def _named(word: str) -> tuple[str, Path]:
    """``NAME=PATH``, or a path that names itself."""
    name, equals, path = word.partition("=")
    return (name, Path(path)) if equals else (Path(word).stem, Path(word))


def _curves(args: argparse.Namespace) -> dict[str, Figure]:
    """One figure per stage that has begun, or of a file of curves; its numbers as csv."""
    from eagle_rl.evaluation import plots
    from eagle_rl.evaluation.curves import curves_to_csv, read_curves
    from eagle_rl.runners.records import read_plan, stage_dir

    figures = {}
    for name, path in map(_named, args.paths):
        stages = (
            {s.name: stage_dir(path, s.name) for s in read_plan(path)} if (path / "plan.json").exists() else {"": path}
        )
        for stage, folder in stages.items():
            file = folder if folder.is_file() else folder / "metrics.jsonl"
            if file.exists() or len(stages) == 1:
                title = f"{name}_{stage}".strip("_").replace("/", "_")
                panels = read_curves(file, args.smooth)
                if panels:
                    figures[title] = plots.learning_curves(panels)
                    _write(args.out / f"curves_{title}.csv", curves_to_csv(panels))
    return figures


def _rounds(args: argparse.Namespace) -> dict[str, Figure]:
    from eagle_rl.evaluation import plots
    from eagle_rl.evaluation.curves import read_rounds
    from eagle_rl.runners.judged import judged_stages
    from eagle_rl.runners.records import read_plan

    figures = {}
    for name, run in map(_named, args.paths):
        judged = [(stage.round, stage.specialised, file) for stage, file in judged_stages(run, read_plan(run))]
        figures[name] = plots.error_rounds(read_rounds(judged))
    return figures


def _latents(args: argparse.Namespace) -> dict[str, Figure]:
    from eagle_rl.evaluation import latents, plots

    from .environment import make_env_factory

    maps, numbers = {}, {}
    for name, path in map(_named, args.paths):
        policy = load_policy(path, args.device)
        cfg, robots = policy.cfg, chosen_robots(args.robots, policy.cfg)
        make_env = make_env_factory(cfg.run)
        found = latents.collect_embeddings(policy.actor, make_env, robots, cfg.task, cfg.evaluation, num_envs=args.envs)
        scores = latents.silhouette(found), latents.probe_accuracy(found)
        maps[name] = (found, latents.tsne(found), *scores)
        numbers[name] = dict(zip(("silhouette", "linear_probe_accuracy"), scores, strict=True))
    _write_numbers(args.out / "latents.json", numbers)
    return {"": plots.latent_maps(maps)}


def _response(args: argparse.Namespace) -> dict[str, Figure]:
    from eagle_rl.evaluation import plots
    from eagle_rl.evaluation.response import command_responses

    from .environment import make_env_factory

    figures = {}
    for name, path in map(_named, args.paths):
        policy = load_policy(path, args.device)
        cfg, robots = policy.cfg, chosen_robots(args.robots, policy.cfg)
        traces = command_responses(policy.actor, make_env_factory(cfg.run), robots, cfg.task, cfg.evaluation)
        figures[name] = plots.responses(traces)
    return figures


def _robustness(args: argparse.Namespace) -> dict[str, Figure]:
    from eagle_rl.evaluation import plots
    from eagle_rl.evaluation.robustness import SWEEPS, sweep

    from .environment import make_env_factory

    figures = {}
    for name, path in map(_named, args.paths):
        policy = load_policy(path, args.device)
        cfg, robots = policy.cfg, chosen_robots(args.robots, policy.cfg)
        ev = dataclasses.replace(cfg.evaluation, num_envs_per_robot=args.envs, num_steps=args.steps)
        make_env = make_env_factory(cfg.run)
        scores = {kind: sweep(policy.actor, make_env, robots, cfg.task, ev, kind) for kind in SWEEPS}
        figures[name] = plots.robustness((SWEEPS[kind], scores[kind]) for kind in SWEEPS)
        plain = {
            kind: {str(v): {r: dataclasses.asdict(m) for r, m in scored.items()} for v, scored in by_value.items()}
            for kind, by_value in scores.items()
        }
        _write_numbers(args.out / f"robustness_{name}.json", plain)
    return figures


def _write_numbers(path: Path, numbers: object) -> None:
    """The numbers behind a figure, as JSON."""
    _write(path, json.dumps(numbers, indent=1) + "\n")


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


DRAW: dict[str, Callable[[argparse.Namespace], dict[str, Figure]]] = {
    "curves": _curves,
    "rounds": _rounds,
    "latents": _latents,
    "response": _response,
    "robustness": _robustness,
}
"""Each returns its figures by the name of what they show."""


def main(argv: Sequence[str]) -> int:
    """Run ``eagle plot``."""
    args = _parser().parse_args(argv)
    require_folder(args.out)
    figures = DRAW[args.figure](args)
    if not figures:
        raise ConfigError(f"{', '.join(args.paths)}: nothing to draw yet.")

    from eagle_rl.evaluation.plots import save

    for name, figure in figures.items():
        for path in save(figure, args.out, f"{args.figure}_{name}".strip("_")):
            print(path)
    return 0
