"""Us against our peers on this machine, in turns: ``python -m benchmarks.peers --unilab PYTHON``.

Each peer needs an environment of its own: ``unilab[mujoco]``; ``gymnasium[mujoco]``; ``mujoco-mjx jax``;
``mjlab``, each with torch for the CPU where it wants torch.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median

from eagle_rl.cli.arguments import count, duration
from eagle_rl.cli.bench import describe_machine, table
from eagle_rl.config.schema import SimCfg
from eagle_rl.errors import EagleError
from eagle_rl.machine import usable_cores
from envs.robots.load import load_robot
from envs.robots.model import add_floor, build_spec

from ..measure import Figure
from ..workloads import experiment
from .contender import Program, take_turns
from .turns import About, Rates, Setting

OURS = Program("ours", "ours", sys.executable)
PEERS = {
    "unilab": (("UniLab", "unilab", ""),),
    "gymnasium": tuple((f"gymnasium {name}", "gymnasium", name) for name in ("AsyncVectorEnv", "SyncVectorEnv")),
    "mjx": (("MJX", "mjx", ""),),
    "mjlab": (("mjlab", "mjlab", ""),),
}
"""Names, modules and variants of what is measured of each peer, by option."""
STANDING_HEIGHT = 0.8
"""Of G1's base over straight legs [m]."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers",
        description="Measure us against peers, on the same cores in turns. Leave the machine alone meanwhile; where "
        "you cannot, set OMP_WAIT_POLICY=PASSIVE, without which torch's threads wait for each other by spinning.",
    )
    for peer in PEERS:
        parser.add_argument(f"--{peer}", metavar="PYTHON", help="interpreter with this peer [it is left out]")
    parser.add_argument("--envs", type=count, nargs="+", default=[64, 320], metavar="N", help="environments [64 320]")
    parser.add_argument("--rounds", type=count, default=3, metavar="N", help="turns of each [3]")
    parser.add_argument("--seconds", type=duration, default=5.0, metavar="S", help="time for each rate in a turn [5]")
    return parser


def _programs(args: argparse.Namespace) -> list[Program]:
    """Us, and the peers there is an interpreter for."""
    programs = [OURS]
    for option, entries in PEERS.items():
        python = getattr(args, option)
        if python is None:
            _say(f"left out: {option}, for which no interpreter was given")
        else:
            programs += [Program(name, module, python, variant) for name, module, variant in entries]
    return programs


def figures(num_envs: int, rates: Mapping[str, Sequence[Rates]]) -> list[Figure]:
    """Each one's rates as shares of ours, from medians over the rounds."""
    if not rates.get(OURS.name):
        raise EagleError("There is nothing to compare peers with: we could not be measured.")
    ours = {kind: median(turn[kind] for turn in rates[OURS.name]) for kind in rates[OURS.name][0]}
    rows = []
    for kind, our_rate in ours.items():
        for name, turns in rates.items():
            measured = [turn[kind] for turn in turns if kind in turn]
            if measured:
                bar = "" if name == OURS.name else "< 1"
                detail = f"{median(measured):.0f} env-steps/s ({min(measured):.0f} to {max(measured):.0f})"
                rows.append(Figure(f"{kind}, {num_envs} envs, {name}", median(measured) / our_rate, "x", bar, detail))
    return rows


def _lines(abouts: Mapping[str, About]) -> str:
    """What each one is, and what differs."""
    return "\n".join(
        f"- {name}: {a.versions}; {a.control}; threads: {a.threads}; {a.differs}." for name, a in abouts.items()
    )


def _write_model(path: Path, sim: SimCfg) -> None:
    """Our G1 on a plane as a MuJoCo file, standing straight where all of its joints are zero."""
    robot = build_spec(load_robot("g1"), sim)
    add_floor(robot)
    robot.worldbody.first_body().pos = [0.0, 0.0, STANDING_HEIGHT]
    for actuator in robot.actuators:
        actuator.ctrlrange = [-3.14, 3.14]
    robot.compile()
    path.write_text(robot.to_xml())


def _say(what: str) -> None:
    print(what, file=sys.stderr)


def main(argv: Sequence[str]) -> None:
    """Measure, and print a table."""
    args = _parser().parse_args(argv)
    programs = _programs(args)
    machine = describe_machine(max(args.envs), usable_cores()) | {"envs": " ".join(map(str, args.envs))}
    machine["OMP_WAIT_POLICY"] = os.environ.get("OMP_WAIT_POLICY", "default")
    rows: list[Figure] = []
    abouts: dict[str, About] = {}
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "g1.xml"
        sim = experiment(usable_cores()).task.sim
        _write_model(model, sim)
        for num_envs in args.envs:
            setting = Setting(num_envs, args.seconds, str(model), sim.decimation)
            found, rates = take_turns(programs, setting, args.rounds, Path(folder), _say)
            abouts |= found
            rows += figures(num_envs, rates)
    print(table(machine, rows))
    print(f"\n{_lines(abouts)}")


if __name__ == "__main__":
    main(sys.argv[1:])
