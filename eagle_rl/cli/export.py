"""``eagle export``: a checkpoint as one ONNX file with its input/output contract, or as a set of files to publish."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from eagle_rl._version import __version__
from eagle_rl.errors import ConfigError

from .policy import load_policy

if TYPE_CHECKING:
    from eagle_rl.config.schema import ExperimentCfg, TaskCfg
    from eagle_rl.export.contract import Contract, Posture, RobotContract, Term
    from envs.mdp.layout import ObservationTerm
    from envs.robots.spec import Array, RobotSpec


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eagle export",
        description="Write a policy as one ONNX file that says itself how to be used.",
        epilog="Try it without torch: eagle sim2sim FILE.onnx --robot g1",
    )
    parser.add_argument("checkpoint", type=Path, metavar="CKPT", help="checkpoint, stage or run")
    parser.add_argument(
        "--out", type=Path, metavar="FILE.onnx", help="[in the folder you are in, named after checkpoint and contract]"
    )
    parser.add_argument(
        "--publish", type=Path, metavar="NAME", help="write NAME.safetensors, NAME.json and NAME.onnx instead"
    )
    return parser


def build_contract(cfg: ExperimentCfg, checkpoint: str, robots: Sequence[str]) -> Contract:
    """The contract of a policy.

    Args:
        cfg: the experiment it comes from.
        checkpoint: sha256 of its checkpoint.
        robots: robots it may drive.
    """
    from eagle_rl.export.contract import Contract
    from envs.mdp.gait import STANDING_PHASE
    from envs.mdp.layout import ObservationLayout
    from envs.robots.load import load_robot
    from envs.robots.slots import SLOT_NAMES

    task = cfg.task
    groups = ObservationLayout(task.observations).groups
    history = groups["history"]
    return Contract(
        version=__version__,
        checkpoint=checkpoint,
        step_dt=task.sim.physics_dt * task.sim.decimation,
        slots=SLOT_NAMES,
        history_length=task.observations.history_length,
        frame=tuple(_term(term) for term in history[: len(history) // task.observations.history_length]),
        command=_term(groups["command"][0]),
        observation_clip=task.observations.clip,
        action_clip=task.control.action_clip,
        gait_phase_offset=task.gait.phase_offset,
        standing_phase=STANDING_PHASE,
        clock_harmonics=task.observations.clock_harmonics,
        posture=_posture(task) if task.control.posture_reference else None,
        robots={spec.name: _robot(spec, cfg) for spec in map(load_robot, robots)},
    )


def _term(term: ObservationTerm) -> Term:
    from eagle_rl.export.contract import Term

    return Term(name=term.name, unit=term.unit, scale=term.scales)


def _posture(task: TaskCfg) -> Posture:
    from eagle_rl.export.contract import Posture
    from envs.mdp.posture import left_over
    from envs.robots.posture import HEIGHTS, PITCHES

    step_dt = task.sim.physics_dt * task.sim.decimation
    return Posture(
        heights=HEIGHTS,
        pitches=PITCHES,
        share=task.control.posture_reference,
        left_over=left_over(task.control, step_dt),
    )


def _robot(spec: RobotSpec, cfg: ExperimentCfg) -> RobotContract:
    from eagle_rl.export.contract import RobotContract
    from envs.pooling import action_scale, gait_frequency
    from envs.robots.posture import joint_offsets

    def numbers(values: Array) -> tuple[float, ...]:
        return tuple(values.tolist())

    return RobotContract(
        joints=spec.joint_names,
        slots=tuple(spec.slots.tolist()),
        signs=numbers(spec.signs),
        zero_offsets=numbers(spec.zero_offsets),
        default_joint_pos=numbers(spec.default_joint_pos),
        action_scale=numbers(action_scale(spec, cfg.task.control)[spec.slots]),
        stiffness=numbers(spec.stiffness),
        damping=numbers(spec.damping),
        effort_limit=numbers(spec.effort_limit),
        nominal_height=spec.nominal_height,
        gait_frequency=gait_frequency(spec, cfg.task.gait),
        posture_offsets=numbers(joint_offsets(spec).ravel()) if cfg.task.control.posture_reference else (),
    )


def main(argv: Sequence[str]) -> int:
    """Run ``eagle export``."""
    args = _parser().parse_args(argv)
    if args.out is not None and args.publish is not None:
        raise ConfigError("--out and --publish: --publish names its own ONNX file. Give one of them.")
    if args.out is not None and (args.out.suffix != ".onnx" or args.out.is_dir()):
        raise ConfigError(f"--out {args.out}: expected the name of a file that ends in .onnx.")
    if args.out is not None and not args.out.absolute().parent.is_dir():
        raise ConfigError(f"--out {args.out}: there is no folder {args.out.parent}. Make it first.")
    if args.publish is not None and args.publish.name in ("", ".."):
        raise ConfigError(f"--publish {args.publish}: expected a name for the files, such as weights/mine.")

    from eagle_rl.export.onnx import export_onnx
    from eagle_rl.runners.checkpoint import publish_policy

    policy = load_policy(args.checkpoint)
    corrected = policy.act is not policy.actor
    if corrected and args.publish is None:
        raise ConfigError(
            f"{policy.checkpoint}: a corrected specialist, whose correction reads the gait's phase, which no ONNX "
            "policy gets. Publish it without ONNX (--publish), or export the generalist that was distilled from it."
        )
    if args.publish is not None:
        policy = load_policy(publish_policy(policy.checkpoint, args.publish, policy.env_steps))
        print(f"{policy.checkpoint}, with its manifest in {policy.checkpoint.with_suffix('.json').name}")
        if corrected:
            print("no ONNX: its correction reads the gait's phase, which no ONNX policy gets")
            return 0
    contract = build_contract(policy.cfg, policy.sha256, policy.cfg.robots)
    own = Path(f"{policy.checkpoint.stem}_{contract.digest[:8]}.onnx")
    out = policy.checkpoint.with_suffix(".onnx") if args.publish else args.out or own
    difference = export_onnx(policy.actor, contract, out)
    print(f"{out}: {', '.join(contract.robots)}; differs from torch by at most {difference:.1g}")
    return 0
