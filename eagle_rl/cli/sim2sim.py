"""``eagle sim2sim``: an exported policy in plain MuJoCo, other step and solver than in training, without torch."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from eagle_rl.config.commands import load_commands
from eagle_rl.config.compose import known_names
from eagle_rl.errors import ConfigError, RobotError

if TYPE_CHECKING:
    import mujoco
    import numpy as np
    from numpy.typing import NDArray

    from eagle_rl.config.commands import CommandScript
    from eagle_rl.export.runtime import OnnxPolicy, Reading
    from envs.robots.spec import RobotSpec

MAX_TILT = 1.0
"""Inclination of the base beyond which the robot counts as fallen [rad]."""
MAX_SUBSTEPS = 1000
"""Physics steps per control step."""
ERRORS = (("E_vx", "m/s"), ("E_vy", "m/s"), ("E_omega", "rad/s"), ("E_h", "m"), ("E_p", "rad"))


@dataclass(frozen=True)
class Outcome:
    """How a policy did."""

    errors: NDArray[np.float64]
    """Mean absolute error of each command while the robot stood, shape (5,)."""
    survived_s: float
    fell: bool


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eagle sim2sim",
        description="An exported policy in plain MuJoCo, with another step and solver than in training, without torch.",
    )
    parser.add_argument("policy", type=Path, metavar="FILE.onnx", help="what eagle export wrote")
    parser.add_argument(
        "--robot",
        required=True,
        metavar="NAME|FILE",
        help="one of the robots in the file: a shipped one by name, another by its YAML",
    )
    parser.add_argument(
        "--commands",
        default="demo",
        metavar="SCRIPT",
        help=f"command script, a YAML file or one of {', '.join(known_names('commands'))} [demo]",
    )
    parser.add_argument("--physics-dt", type=float, default=0.002, metavar="S", help="physics step [0.002]")
    return parser


def main(argv: Sequence[str]) -> int:
    """Run ``eagle sim2sim``."""
    args = _parser().parse_args(argv)
    script = load_commands(args.commands)

    from eagle_rl.export.runtime import OnnxPolicy

    spec = _load_robot(args.robot, args.policy)
    policy = OnnxPolicy(args.policy, spec.name)
    substeps = round(policy.contract.step_dt / args.physics_dt) if args.physics_dt > 0 else 0
    if not 1 <= substeps <= MAX_SUBSTEPS or abs(substeps * args.physics_dt - policy.contract.step_dt) > 1e-9:
        step = policy.contract.step_dt
        raise ConfigError(f"--physics-dt: got {args.physics_dt:g}, expected a whole fraction of {step:g} s.")
    outcome = simulate(policy, spec, script, substeps)
    fate = f"fell after {outcome.survived_s:.1f} s" if outcome.fell else f"stood for all of {outcome.survived_s:.1f} s"
    print(f"{spec.name}: {fate}, physics step {args.physics_dt:g} s")
    for (name, unit), error in zip(ERRORS, outcome.errors, strict=True):
        print(f"  {name:<8}{error:7.3f} {unit}")
    return 0


def _load_robot(robot: str, policy: Path) -> RobotSpec:
    """The body of a robot, which a policy's file does not hold."""
    from eagle_rl.export.runtime import load_session
    from envs.robots.load import load_robot

    known = load_session(policy)[1].robots
    if robot in known and robot not in known_names("robots"):
        raise RobotError(
            f"{robot} is in {policy}; plain MuJoCo needs its YAML too: --robot PATH, with `name: {robot}` in that file."
        )
    return load_robot(robot)


def simulate(policy: OnnxPolicy, spec: RobotSpec, script: CommandScript, substeps: int) -> Outcome:
    """Follow a script until its end or a fall."""
    import mujoco
    import numpy as np

    model = _model(policy, spec, policy.contract.step_dt / substeps)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    policy.reset()
    num_steps = round(script.duration / policy.contract.step_dt)
    errors: list[NDArray[np.float64]] = []
    for step in range(num_steps):
        command = script.at(step * policy.contract.step_dt)
        data.ctrl[:] = policy.step(read(data), command)
        mujoco.mj_step(model, data, substeps)
        measured, tilt = _measure(data, policy.robot.nominal_height)
        if tilt > MAX_TILT or not np.isfinite(data.qvel).all():
            return Outcome(np.mean(errors or [np.full(5, np.nan)], axis=0), float(data.time), fell=True)
        errors.append(np.abs(command - measured))
    return Outcome(np.mean(errors, axis=0), float(data.time), fell=False)


def _model(policy: OnnxPolicy, spec: RobotSpec, physics_dt: float) -> mujoco.MjModel:
    """The robot on a floor, with MuJoCo's own solver settings and the contract's gains."""
    from eagle_rl.config.schema import SimCfg
    from envs.robots.model import build_model

    sim = SimCfg(physics_dt=physics_dt, decimation=1, solver_iterations=100, solver_ls_iterations=50)
    if spec.joint_names != policy.robot.joints:
        raise ConfigError(f"{spec.name}: its joints are not those of the policy's contract; export the policy again.")
    model = build_model(spec, sim)
    model.actuator_gainprm[:, 0] = policy.robot.stiffness
    model.actuator_biasprm[:, 1] = [-gain for gain in policy.robot.stiffness]
    model.dof_damping[6:] = policy.robot.damping
    model.actuator_forcerange[:] = [(-effort, effort) for effort in policy.robot.effort_limit]
    return model


def read(data: mujoco.MjData) -> Reading:
    """The sensors of the simulated robot."""
    from eagle_rl.export.runtime import Reading

    return Reading(
        base_quat=data.qpos[3:7].copy(),
        base_ang_vel=data.qvel[3:6].copy(),
        joint_pos=data.qpos[7:].copy(),
        joint_vel=data.qvel[6:].copy(),
    )


def _measure(data: mujoco.MjData, nominal_height: float) -> tuple[NDArray[np.float64], float]:
    """What the command asks for as it is, shape (5,), and the inclination of the base [rad]."""
    import mujoco
    import numpy as np

    from eagle_rl.export.runtime import projected_gravity

    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, data.qpos[3:7])
    velocity = rotation.reshape(3, 3).T @ data.qvel[:3]
    gravity = projected_gravity(data.qpos[3:7])
    pitch = np.arctan2(gravity[0], -gravity[2])
    measured = np.array([velocity[0], velocity[1], data.qvel[5], data.qpos[2] - nominal_height, pitch])
    return measured, float(np.arccos(np.clip(-gravity[2], -1.0, 1.0)))
