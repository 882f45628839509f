"""``eagle plot``: figures from runs and checkpoints, as PNG and PDF."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from eagle_rl.config.schema import EvaluationCfg, ExperimentCfg, ObservationsCfg
from eagle_rl.errors import ConfigError
from eagle_rl.paths import RUNS, misplaced

from .arguments import count, device, require_folder
from .environment import make_env_factory
from .policy import Policy, chosen_robots, load_policy

if TYPE_CHECKING:
    from eagle_rl.evaluation.estimator import Channel
    from eagle_rl.evaluation.metrics import RobotMetrics
    from eagle_rl.evaluation.plots import Figure
    from eagle_rl.evaluation.robustness import Sweep

FIGURES = {
    "curves": "learning curves per robot of a run's stages",
    "rounds": "tracking errors over rounds, specialists and generalists marked",
    "latents": "t-SNE of e(s_t) of walking robots, silhouette score and linear probe, one panel per checkpoint",
    "response": "commanded and measured traces of all five commands",
    "robustness": "survival and errors under pushes, friction, payload and latency",
    "bodies": "survival and errors of bodies of other sizes, masses and proportions, further and further away",
    "estimator": "explained variance of base velocity and o_ea on randomized robots; also md, csv, json",
    "postures": "pictures of a squat and a lean of every robot",
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
    parser.add_argument(
        "--steps", type=count, default=500, metavar="N", help="control steps of robustness, bodies, estimator [500]"
    )
    parser.add_argument("--smooth", type=count, default=10, metavar="N", help="iterations averaged in curves [10]")
    return parser


def _named(words: Sequence[str]) -> dict[str, Path]:
    """Paths by name: ``NAME=PATH``, or a path that names itself.

    Raises:
        ConfigError: two have one name, under which the second would be drawn over the first.
    """
    found: dict[str, Path] = {}
    for word in words:
        name, equals, rest = word.partition("=")
        path = Path(rest if equals else word)
        name = name if equals else path.stem
        if name in found:
            raise ConfigError(f"{found[name]} and {path}: both are named {name!r}. Name them apart: NAME=PATH.")
        found[name] = path
    return found


def _curves(args: argparse.Namespace) -> dict[str, Figure]:
    """One figure per stage that has begun, or of a file of curves; its numbers as csv."""
    from eagle_rl.evaluation import plots
    from eagle_rl.evaluation.curves import curves_to_csv, read_curves
    from eagle_rl.runners.records import read_plan, stage_dir

    figures = {}
    for name, path in _named(args.paths).items():
        stages = (
            {s.name: stage_dir(path, s.name) for s in read_plan(path)} if (path / "plan.json").exists() else {"": path}
        )
        files = {stage: folder if folder.is_file() else folder / "metrics.jsonl" for stage, folder in stages.items()}
        begun = {stage: file for stage, file in files.items() if file.exists()}
        if not begun:
            wrong = "no numbers of training there. Name a run, or the folder of a stage, that has begun."
            raise ConfigError(misplaced(path, wrong, *RUNS))
        for stage, file in begun.items():
            title = f"{name}_{stage}".strip("_").replace("/", "_")
            panels = read_curves(file, args.smooth)
            if panels:
                figures[title] = plots.learning_curves(panels)
                _write(args.out / f"curves_{title}.csv", curves_to_csv(panels))
    return figures


def _rounds(args: argparse.Namespace) -> dict[str, Figure]:
    """One figure per run, or file of its scores; the scores as csv."""
    from eagle_rl.evaluation import plots
    from eagle_rl.evaluation.curves import read_rounds, rounds_from_csv, rounds_to_csv
    from eagle_rl.runners.judged import judged_stages
    from eagle_rl.runners.records import read_plan

    figures = {}
    for name, path in _named(args.paths).items():
        if path.suffix == ".csv":
            scores = rounds_from_csv(path)
        else:
            judged = judged_stages(path, read_plan(path))
            scores = read_rounds([(stage.position, stage.specialised, file) for stage, file in judged])
        figures[name] = plots.error_rounds(scores)
        _write(args.out / f"rounds_{name}.csv", rounds_to_csv(scores))
    return figures


def _policies(args: argparse.Namespace) -> Iterator[tuple[str, Policy, tuple[str, ...]]]:
    """Name, policy and robots to show of each checkpoint."""
    for name, path in _named(args.paths).items():
        policy = load_policy(path, args.device)
        yield name, policy, chosen_robots(args.robots, policy.cfg)


def _protocol(args: argparse.Namespace, cfg: ExperimentCfg) -> EvaluationCfg:
    return replace(cfg.evaluation, num_envs_per_robot=args.envs, num_steps=args.steps)


def _latents(args: argparse.Namespace) -> dict[str, Figure]:
    from eagle_rl.evaluation import latents, plots

    maps, numbers = {}, {}
    for name, policy, robots in _policies(args):
        cfg = policy.cfg
        make_env = make_env_factory(cfg.run)
        found = latents.collect_embeddings(policy.actor, make_env, robots, cfg.task, cfg.evaluation, num_envs=args.envs)
        scores = latents.silhouette(found), latents.probe_accuracy(found)
        maps[name] = (found, latents.tsne(found), *scores)
        measured = dict(zip(("silhouette", "linear_probe_accuracy"), scores, strict=True))
        numbers[name] = _provenance(policy, replace(cfg.evaluation, num_envs_per_robot=args.envs)) | measured
    _write_numbers(args.out / "latents.json", numbers)
    return {"": plots.latent_maps(maps)}


def _response(args: argparse.Namespace) -> dict[str, Figure]:
    from eagle_rl.evaluation import plots
    from eagle_rl.evaluation.response import command_responses

    figures = {}
    for name, policy, robots in _policies(args):
        cfg = policy.cfg
        traces = command_responses(policy.act, make_env_factory(cfg.run), robots, cfg.task, cfg.evaluation)
        figures[name] = plots.responses(traces)
    return figures


def _robustness(args: argparse.Namespace) -> dict[str, Figure]:
    from eagle_rl.evaluation.robustness import DISTURBANCES

    return _swept(args, DISTURBANCES)


def _bodies(args: argparse.Namespace) -> dict[str, Figure]:
    from eagle_rl.evaluation.robustness import BODIES

    return _swept(args, BODIES)


def _swept(args: argparse.Namespace, sweeps: Mapping[str, Sweep]) -> dict[str, Figure]:
    """Every sweep side by side; the numbers as json."""
    from eagle_rl.evaluation import plots
    from eagle_rl.evaluation.protocol import finishing_ranges
    from eagle_rl.evaluation.robustness import sweep

    figures = {}
    for name, policy, robots in _policies(args):
        cfg, make_env = policy.cfg, make_env_factory(policy.cfg.run)
        ev = _protocol(args, cfg)
        scores = {kind: sweep(policy.act, make_env, robots, cfg.task, ev, through) for kind, through in sweeps.items()}
        panels = [(sweeps[kind], scores[kind]) for kind in sweeps]
        figures[name] = plots.robustness(panels, ev, finishing_ranges(cfg.task.commands))
        plain = {
            kind: {str(value): {robot: _brief(m) for robot, m in scored.items()} for value, scored in by_value.items()}
            for kind, by_value in scores.items()
        }
        _write_numbers(args.out / f"{args.figure}_{name}.json", _provenance(policy, ev) | plain)
    return figures


def _brief(metrics: RobotMetrics) -> dict[str, object]:
    """Scores over all steps."""
    return {"survival": metrics.survival, "upright": metrics.upright} | asdict(metrics.subsets["all"])


def _provenance(policy: Policy, ev: EvaluationCfg) -> dict[str, object]:
    """What has to be known to repeat the numbers of a figure."""
    return {"checkpoint": policy.sha256, "protocol": asdict(ev)}


def _estimator(args: argparse.Namespace) -> dict[str, Figure]:
    from eagle_rl.evaluation import plots
    from eagle_rl.evaluation.estimator import judge_estimator
    from eagle_rl.evaluation.estimator_report import describe, to_csv, to_markdown

    figures = {}
    for name, policy, robots in _policies(args):
        cfg, ev = policy.cfg, _protocol(args, policy.cfg)
        channels = estimate_channels(cfg.task.observations)
        report = judge_estimator(policy.actor, make_env_factory(cfg.run), robots, cfg.task, ev, channels)
        figures[name] = plots.estimator_bars(report)
        table = to_markdown(report, describe(args.envs, args.steps, ev.seed, policy.sha256))
        print(table)
        _write(args.out / f"estimator_{name}.md", table)
        _write(args.out / f"estimator_{name}.csv", to_csv(report))
        _write_numbers(args.out / f"estimator_{name}.json", _provenance(policy, ev) | asdict(report))
    return figures


def estimate_channels(cfg: ObservationsCfg) -> tuple[Channel, ...]:
    """What the estimator's columns hold: base velocity and, if it is on, the paper's o_ea."""
    from eagle_rl.evaluation.estimator import Channel
    from envs.robots.embodiment import EMBODIMENT_LINKS, LINK_CHANNELS, reference_statistics

    channels = tuple(Channel(name=f"base v_{axis}", unit="m/s", scale=1.0 / cfg.scales.base_lin_vel) for axis in "xyz")
    if not cfg.embodiment_observation:
        return channels
    names = [(f"{link.replace('_', ' ')} {name}", unit) for link in EMBODIMENT_LINKS for name, unit in LINK_CHANNELS]
    spread = reference_statistics()[1].tolist()
    bodies = (Channel(name=name, unit=unit, scale=std) for (name, unit), std in zip(names, spread, strict=True))
    return (*channels, *bodies)


def _postures(args: argparse.Namespace) -> dict[str, Figure]:
    from eagle_rl.evaluation import plots

    from .postures import POSTURES, strips

    return {
        f"{posture}_{name}": plots.film_strips(strips(policy, robots, posture))
        for name, policy, robots in _policies(args)
        for posture in POSTURES
    }


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
    "bodies": _bodies,
    "estimator": _estimator,
    "postures": _postures,
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
