"""``eagle robots``: what the shipped robots are, slot by slot, and whether a new one is complete."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console

from eagle_rl.config.schema import RandomizationCfg

from .mdp_summary import make_table, randomization_table

if TYPE_CHECKING:
    from envs.robots.spec import RobotSpec

TABLE_WIDTH = 160
"""Columns that the widest table needs; a narrower terminal wraps lines, which reads better than folded cells."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eagle robots", description="Show the shipped robots, slot by slot, or check a new one."
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="list|show|check|slots")
    actions.add_parser("list", help="one line a robot")
    actions.add_parser("slots", help="the 32 slots and the joint each robot has in them")
    show = actions.add_parser("show", help="every joint with slot, limits and gains; links by role")
    show.add_argument("robot", metavar="NAME|FILE")
    show.add_argument("--randomization", action="store_true", help="what domain randomization varies, and by how much")
    check = actions.add_parser("check", help="load, compile and compare a robot; say what is wrong in words")
    check.add_argument("robot", nargs="+", metavar="NAME|FILE")
    return parser


def _list(console: Console) -> None:
    from envs.robots.load import load_robot, robot_names

    rows = []
    for spec in map(load_robot, robot_names()):
        numbers = (str(spec.num_joints), f"{spec.total_mass:.2f}", f"{spec.nominal_height:.3f}")
        rows.append((spec.name, spec.title, *numbers, spec.urdf_path.name))
    console.print(make_table("", ("name", "robot", "joints", "mass [kg]", "height [m]", "URDF"), rows))


def _slots(console: Console) -> None:
    from envs.robots.load import load_robot, robot_names
    from envs.robots.slots import SLOT_NAMES

    specs = [load_robot(name) for name in robot_names()]
    joints = [dict(zip(spec.slots.tolist(), spec.joint_names, strict=True)) for spec in specs]
    rows = [(str(i), slot, *(j.get(i, "") for j in joints)) for i, slot in enumerate(SLOT_NAMES)]
    console.print(make_table("", ("", "slot", *(s.name for s in specs)), rows))


def _show(spec: RobotSpec, console: Console) -> None:
    from envs.robots.check import COLUMNS, describe

    title = f"{spec.title}: {spec.num_joints} joints, {spec.total_mass:.2f} kg, base at {spec.nominal_height:.3f} m"
    console.print(make_table(f"{title} (rad, N m, rad/s, native signs)", COLUMNS, describe(spec)))
    console.print()
    console.print(make_table("Links by role", ("role", "link"), spec.link_roles.items()))
    console.print(f"\nswing height {spec.swing_height:.3f} m, base {spec.base_link}, IMU on {spec.imu_link}")
    console.print(f"{spec.yaml_path}\n{spec.urdf_path}", highlight=False, soft_wrap=True)
    for topic, source in spec.sources.items():
        console.print(f"{topic}: {source}", highlight=False, markup=False, soft_wrap=True)


def _show_randomization(spec: RobotSpec, console: Console) -> None:
    cfg = RandomizationCfg()
    low, high = (ratio * spec.total_mass for ratio in cfg.base_mass_ratio)
    console.print(randomization_table(cfg))
    console.print(f"\n{spec.title}: mass added to the base from {low:+.2f} to {high:+.2f} kg", highlight=False)


def _check(name: str, console: Console) -> None:
    """Load and compile a robot: faults are raised as ``RobotError``, what is merely odd is printed."""
    from envs.robots.check import check_robot
    from envs.robots.load import load_robot

    findings = check_robot(name)
    spec = load_robot(name)
    verdict = "can be used" + (f"; {len(findings)} worth knowing:" if findings else "")
    console.print(f"{spec.name}: {spec.num_joints} joints, {spec.total_mass:.3f} kg: {verdict}", highlight=False)
    for finding in findings:
        console.print(f"  {finding}", highlight=False, markup=False, soft_wrap=True)


def main(argv: Sequence[str]) -> int:
    """Run ``eagle robots``."""
    args = _parser().parse_args(argv)
    console = Console()
    console.width = max(console.width, TABLE_WIDTH)
    if args.action == "list":
        _list(console)
    elif args.action == "slots":
        _slots(console)
    elif args.action == "check":
        for name in args.robot:
            _check(name, console)
    else:
        from envs.robots.load import load_robot

        spec = load_robot(args.robot)
        (_show_randomization if args.randomization else _show)(spec, console)
    return 0
