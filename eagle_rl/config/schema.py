"""The one schema: what an experiment may say, with units, defaults and the source of each default.

Sources: ``paper`` is the EAGLE paper, ``HugWBC n`` the n-th section of its inherited facts, ``ours`` a choice recorded
in ``docs/decisions.md``. Pure data: nothing here imports torch or MuJoCo, so that a wrong key is reported at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from .task_schema import (
    AidsCfg,
    CommandCurriculumCfg,
    CommandRangeCfg,
    CommandsCfg,
    ControlCfg,
    GaitCfg,
    NoiseCfg,
    ObservationScalesCfg,
    ObservationsCfg,
    RandomizationCfg,
    Range,
    RewardsCfg,
    RewardWeightsCfg,
    SimCfg,
    TaskCfg,
    TerminationsCfg,
    TerrainCfg,
)

__all__ = [
    "AidsCfg",
    "AlgoCfg",
    "CommandCurriculumCfg",
    "CommandRangeCfg",
    "CommandsCfg",
    "ControlCfg",
    "EvaluationCfg",
    "ExperimentCfg",
    "GaitCfg",
    "NetworkCfg",
    "NoiseCfg",
    "ObservationScalesCfg",
    "ObservationsCfg",
    "PlanCfg",
    "RandomizationCfg",
    "Range",
    "RewardWeightsCfg",
    "RewardsCfg",
    "RunCfg",
    "SearchCfg",
    "SimCfg",
    "TaskCfg",
    "TerminationsCfg",
    "TerrainCfg",
]


@dataclass(frozen=True, kw_only=True)
class NetworkCfg:
    """Layer widths (HugWBC 6)."""

    embedding_dim: int = 32
    """Size of e(s_t) [-]."""
    encoder_dims: tuple[int, ...] = (256, 128)
    """Hidden layers of the history's encoder."""
    estimator_dims: tuple[int, ...] = (64, 32)
    """Hidden layers of the estimator of base velocity and o_ea."""
    actor_dims: tuple[int, ...] = (256, 128, 64)
    """Hidden layers of the policy head."""
    critic_dims: tuple[int, ...] = (512, 256, 128)
    """Hidden layers of the critic."""
    activation: Literal["elu", "relu", "tanh"] = "elu"
    """After every hidden layer."""
    init_std: float = 0.7
    """Initial standard deviation of every action [-] (ours)."""
    std_range: Range = (0.1, 1.2)
    """Bounds of the standard deviation (HugWBC 6)."""
    symmetric: bool = False
    """Act by the mean of what the networks say of a robot and, in the mirror, of its mirror image: left and right are
    then exactly alike, without a mirror loss and for twice the actor's products (docs/experiments.md, 29) (ours)."""


@dataclass(frozen=True, kw_only=True)
class AlgoCfg:
    """PPO and the losses added to it."""

    num_steps_per_env: int = 24
    """Control steps per environment and iteration (HugWBC 7)."""
    num_learning_epochs: int = 4
    """Passes over the data of an iteration (ours; HugWBC 5)."""
    num_mini_batches: int = 4
    """Minibatches in a pass (HugWBC 7)."""
    clip_param: float = 0.2
    """PPO's bound on the change of a probability ratio [-] (HugWBC 7)."""
    gamma: float = 0.99
    """Discount per control step [-] (HugWBC 7)."""
    lam: float = 0.95
    """lambda of the generalised advantage estimate [-] (HugWBC 7)."""
    learning_rate: float = 1e-3
    """Of the actor at the start; ``desired_kl`` moves it (HugWBC 7)."""
    learning_rate_range: Range = (1e-5, 2e-3)
    """Bounds of the actor's learning rate (ours; HugWBC to 1e-2)."""
    desired_kl: float = 0.01
    """KL target of the actor's learning rate, which moves once an iteration (ours: per minibatch it bounced)."""
    critic_learning_rate: float = 5e-4
    """Of the critic, fixed (ours): the KL says nothing about the critic, which starved at the actor's 4e-5."""
    entropy_coef: float = 0.002
    """Weight of the entropy bonus (ours; HugWBC 0.01)."""
    value_loss_coef: float = 1.0
    """Weight of the critic's loss (HugWBC 7)."""
    use_clipped_value_loss: bool = False
    """Clip the change of values as that of ratios (ours; HugWBC does)."""
    max_grad_norm: float = 1.0
    """Bound on the norm of the gradient (HugWBC 7)."""
    estimation_coef: float = 2.0
    """Weight of the estimator's loss on base velocity and o_ea, each a mean over its own dimensions (HugWBC 6)."""
    mirror_coef: float = 0.5
    """Weight of the left/right mirror loss (HugWBC 6); 0 is off."""
    mirror_fraction: float = 0.25
    """Share of each minibatch the mirror loss is computed on (ours)."""
    use_ppo_loss: bool = True
    """Whether distillation has PPO's loss too. Off leaves only the imitation losses: pure DAgger (ablation). Stages
    that imitate nobody always have it."""
    action_loss_coef: float = 0.02
    """alpha, weight of L_a in distillation (paper)."""
    action_loss_unit: Literal["action", "noise"] = "action"
    """Of actions in L_a: as the policy gives them (paper), or multiples of the specialist's noise (ours)."""
    embedding_loss_coef: float = 1.0
    """beta, weight of L_e in distillation (paper)."""
    kickstart_coef: float = 1.0
    """alpha of Kickstarting's alpha * exp(-lambda t) * KL(pi_s || pi_g); not given by the paper (ours)."""
    kickstart_decay: float = 0.005
    """lambda per iteration (ours)."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the hidden layers in training; ``auto`` is bfloat16 where the CPU is quicker in it, too coarse once a
    policy's noise is small. Parameters, outputs, losses, evaluation and specialists' labels are float32 in any
    case (docs/performance.md) (ours)."""
    network: NetworkCfg = field(default_factory=NetworkCfg)


@dataclass(frozen=True, kw_only=True)
class PlanCfg:
    """What an experiment trains, in environment steps (one robot, one 50 Hz control step)."""

    method: Literal["ppo", "eagle", "kickstarting", "compass"] = "ppo"
    """How, the rows of the paper's table; ``ppo`` has a generalist and no rounds."""
    generalist_env_steps: int = 20_000_000
    """Budget of the root policy."""
    specialist_env_steps: int = 0
    """Budget of each specialist's training, per round; 0, where there is a search, starts that from the generalist."""
    specialist_num_envs: int = 0
    """Environments of a specialist; 0 for as many as the pool has: its batches are then so many times larger than one
    robot's share of the pool, and its iterations fewer (ours)."""
    distill_env_steps: int = 0
    """Budget of each distillation, per round."""
    start_share: float = 0.0
    """Share of the weights a round, or a root that PPO goes on with, started from in those it ends with. Halves of both
    ends follow as well as the new one and fall less when disturbed (ours; docs/experiments.md, 20 and 37)."""
    base_env_steps: int = 0
    """Budget of COMPASS's base policy, which imitates the root; 0 makes the root itself its base."""
    max_rounds: int = 1
    """Rounds of specialise and generalise; 1 is the paper's EAGLE, more its "w/ ID"."""
    tolerance: float = 0.01
    """Rounds stop when the pooled tracking score improves by less than this share."""
    root: str | None = None
    """Checkpoint to fork from instead of training a generalist; with method ``ppo`` the generalist's budget is then
    spent on continuing from it."""
    teachers: tuple[str, ...] = ()
    """Who teaches each robot in the first round, in the order of ``robots``: ``specialist``, one of the round's own,
    ``generalist``, the policy the round starts from, or the file of a specialist; without any, specialists (ours)."""
    search_env_steps: int = 0
    """Budget of the search that follows each specialist's training; 0 for none (ours)."""
    correction_env_steps: int = 0
    """Budget of the probes from which each specialist's errors are corrected in the end; 0 for none (ours)."""
    judge_envs_per_robot: int = 64
    """Environments per robot in the evaluation that ends each stage and decides on convergence; 0 leaves it out."""


@dataclass(frozen=True, kw_only=True)
class SearchCfg:
    """Search over a specialist's last layer, with tracking errors for a cost (ours; docs/experiments.md, 20)."""

    num_pairs: int = 192
    """Pairs of policies tried in a generation [-]."""
    num_steps: int = 240
    """Control steps each of them is given, from rest; after shorter ones Adam fell in 20 s."""
    settling_steps: int = 40
    """The first of them, which are not judged."""
    resampling_time_s: float = 2.4
    """Time between commands [s]; 0 keeps the first."""
    standing_probability: float = 0.2
    """Share of commands without velocity [-]."""
    num_directions: int = 24
    """Principal directions of the last hidden layer that are searched, for each joint [-]."""
    std: float = 0.015
    """Perturbation of an action by each direction [-]."""
    step: float = 0.125
    """Length of the first step as a share of that of a perturbation [-]; the last one is a fifth of it."""
    error_units: tuple[float, float, float, float, float] = (0.05, 0.08, 0.05, 0.02, 0.04)
    """Errors of v_x, v_y, omega, height and pitch that weigh the same [m/s, m/s, rad/s, m, rad]."""
    randomized_share: float = 0.5
    """Share of pairs in the world of training, with its bodies, motors, noise and pushes [-]; the best where nothing
    disturbs falls more where something does."""


@dataclass(frozen=True, kw_only=True)
class CorrectionCfg:
    """Correction of a specialist by what its errors have of command and phase (ours; docs/experiments.md, 22).

    Errors weigh as in the search, by ``search.error_units``.
    """

    num_envs: int = 768
    """Robots in a rollout; a probe takes three rollouts [-]."""
    num_steps: int = 220
    """Control steps of a rollout, from rest; robots in trials then follow another command for as many."""
    upright_share: float = 0.25
    """Of the robots, whose height and pitch commands are zero [-]; see ``task.commands.upright_probability``."""
    settling_steps: int = 60
    """The first of them, which are not looked at."""
    gain_std: float = 0.03
    """Of the changes tried of every gain by which a joint answers the yaw rate's error [s/rad]; 0 tunes none."""
    foresight_std: float = 0.05
    """Of the noise on every action from which foresight of errors is learned, in the unit of ``std``; 0 for none."""
    foresight_steps: int = 5
    """Control steps that are looked ahead."""
    std: float = 0.03
    """Of the changes tried for every joint and harmonic [-]; 1 is an angle, an action's in the geometric mean. With 0
    foresight stands alone, no pass is made."""
    damping: float = 6.0
    """Number of error units that weigh as much as a change of 1 [-]; with less of it robots fall."""


@dataclass(frozen=True, kw_only=True)
class EvaluationCfg:
    """Protocol of the tracking table (paper, Eq. E_d)."""

    num_envs_per_robot: int = 256
    """Environments of each robot (ours: minutes on a CPU); the paper has 2048, as ``cfg/scale/paper.yaml``."""
    num_steps: int = 1000
    """Control steps, 20 s (paper)."""
    protocol: Literal["single", "joint", "upright", "standing"] = "joint"
    """``single`` varies one command and keeps the others at zero; ``joint`` samples all five; ``upright`` samples the
    velocities and keeps height and pitch at zero, as a robot is driven that has no others; ``standing`` samples
    posture with all velocities exactly zero, in every second draw where commands are redrawn."""
    resampling_time_s: float = 0.0
    """0 keeps commands for the episode; otherwise redraw every so many seconds."""
    randomization: bool = False
    """Dynamics as randomized in training, pushes included at full strength; off is the nominal robot."""
    noise: bool = False
    """Sensor noise as in training."""
    seed: int = 1234
    """Of commands, resets and randomization."""
    physics_dt: float = 0.005
    """Physics step [s] (ours); finer than in training."""
    decimation: int = 4
    """Physics steps per control step [-]; physics_dt * decimation must be 0.02 s."""


@dataclass(frozen=True, kw_only=True)
class RunCfg:
    """Bookkeeping of a run."""

    device: str = "cpu"
    """Of the learner: ``cpu``, ``cuda`` or ``cuda:N``."""
    env_device: str = "cpu"
    """Of observations, rewards and commands in training. They are many small steps, which a core beside the physics
    takes in the time a GPU needs to be asked for them (docs/performance.md)."""
    num_threads: int = 0
    """Physics threads; 0 takes every core, under torchrun its process's share of them."""
    torch_threads: int = 0
    """Threads of the learner on a CPU, among which the rows of each minibatch are shared out; 0 takes every core, under
    torchrun or ``--jobs`` the process's share of them. They sleep while they wait, so that on a busy machine they are
    hardly slower than one. Results depend in the last digits on their number, and so with 0 on the machine; never on
    what else runs."""
    compile: Literal["auto", "always", "never"] = "auto"
    """Whether training takes the environments' steps, acts and learns by kernels compiled from the code, equal up to
    rounding. ``auto`` does on a CPU, in stages of five million steps and more, from control step 1000 on: compiling
    takes about a minute, the next time some seconds. ``always`` does from the first step on (docs/performance.md)."""
    save_interval: int = 50
    """Iterations between checkpoints."""
    keep_checkpoints: int = 3
    """How many of the newest are kept; the best and the ends of stages always are."""


@dataclass(frozen=True, kw_only=True)
class ExperimentCfg:
    """One experiment: a row of the paper's tables, or one of ours."""

    name: str
    """Name of its folder in ``logs``; that of the file where the file says none."""
    description: str = ""
    """One sentence for people."""
    robots: tuple[str, ...] = ("h1", "g1", "t1", "n1", "adam")
    """Names in ``cfg/robots``, or YAML files of robots."""
    num_envs: int = 320
    """Environments over all robots together [-]; a remainder is spread over the first robots."""
    seed: int = 1
    """Of everything drawn in training."""
    task: TaskCfg = field(default_factory=TaskCfg)
    algo: AlgoCfg = field(default_factory=AlgoCfg)
    plan: PlanCfg = field(default_factory=PlanCfg)
    search: SearchCfg = field(default_factory=SearchCfg)
    correction: CorrectionCfg = field(default_factory=CorrectionCfg)
    evaluation: EvaluationCfg = field(default_factory=EvaluationCfg)
    run: RunCfg = field(default_factory=RunCfg)
