"""The task's part of the schema: what is simulated, commanded, observed, rewarded and randomized.

Units, defaults and sources as in :mod:`eagle_rl.config.schema`, which has the rest and all names.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class SimCfg:
    """Physics stepping of one robot."""

    physics_dt: float = 0.01
    """Physics step [s]; training 0.01 x 2, evaluation 0.005 x 4 (ours, measured: half the cost, same policy)."""
    decimation: int = 2
    """Physics steps per 50 Hz control step [-]; physics_dt * decimation must be 0.02 s (HugWBC 3)."""
    solver_iterations: int = 5
    """Newton iterations [-] (ours, measured: unchanged against 100)."""
    solver_ls_iterations: int = 10
    """Line-search iterations [-] (ours)."""
    self_collision: bool = True
    """Whether a robot's own links collide (HugWBC 3)."""


@dataclass(frozen=True, kw_only=True)
class TerrainCfg:
    """The ground."""

    kind: Literal["plane", "rough", "slopes", "steps"] = "plane"
    """Shape of the ground; the paper names none, flat is its most likely reading."""
    num_levels: int = 10
    """Difficulty levels of the terrain curriculum [-] (HugWBC 8)."""
    roughness: float = 0.02
    """Half amplitude of the height noise at the hardest level [m] (HugWBC 8)."""
    slope: float = 0.2
    """Slope at the hardest level [rad] (ours)."""
    step_height: float = 0.1
    """Step height at the hardest level [m] (ours)."""
    patch_size: float = 8.0
    """Side of one patch [m] (HugWBC 8)."""
    cell_size: float = 0.1
    """Horizontal resolution of the height field [m] (ours: 0.05 costs twice the collision time)."""


@dataclass(frozen=True, kw_only=True)
class ControlCfg:
    """From action to PD target: ``q_target = q_default + scale_j * a_j`` in canonical angles."""

    action_scale: float = 0.25
    """Radians per unit action before the effort rule [rad] (HugWBC 3)."""
    action_clip: float = 100.0
    """Bound on actions [-] (HugWBC 3)."""
    min_effort_ratio: float = 0.25
    """Lower bound of the factor ``min(1, effort/kp)`` on ``action_scale`` [-] (ours: stiff weak joints turn noise into
    saturated torque)."""
    min_effort_ratio_leg_pitch: float = 0.6
    """The same bound for hip pitch, knee and ankle pitch, which must travel far to squat [-] (ours)."""
    min_effort_ratio_shoulder_pitch: float = 0.25
    """The same bound for shoulder pitch: arms that swing hold the pelvis still [-] (ours)."""
    hip_yaw_ratio: float = 0.5
    """Extra factor at hip yaw [-] (ours, from the single-robot study)."""
    upper_ratio: float = 0.5
    """Extra factor at head and arms [-] (ours)."""
    waist_ratio: float = 0.5
    """Extra factor at the waist [-] (ours: the noise of a stiff waist shakes a light pelvis; at 0.5 it makes up half of
    the yaw-rate error H1 has in training)."""
    posture_reference: float = 0.0
    """Share of the commanded height and pitch to which the targets' resting pose bends by itself, so that the policy
    need not learn the kinematics of a squat [-]; 0 rests in the default pose. Above 1 it bends further than commanded,
    for walking takes some of it back (ours)."""
    posture_time_constant: float = 0.5
    """Lag with which that pose follows the command [s] (ours)."""


@dataclass(frozen=True, kw_only=True)
class CommandRangeCfg:
    """Range of one command at the start and at the end of the curriculum."""

    initial: Range
    finishing: Range


@dataclass(frozen=True, kw_only=True)
class CommandCurriculumCfg:
    """Grid curriculum over (v_x, omega), one grid per robot (HugWBC 2)."""

    enabled: bool = True
    """Off: commands come from the finishing ranges at once."""
    num_bins_lin_vel_x: int = 12
    """Bins of v_x over its finishing range [-] (ours)."""
    num_bins_ang_vel_z: int = 8
    """Bins of omega over its finishing range [-] (ours)."""
    neighbour_radius: float = 0.25
    """Bins whose centre is this near in both v_x [m/s] and omega [rad/s] gain weight on success."""
    weight_step: float = 0.2
    """Weight gained on success [-]; weights stay in [0, 1] and never fall."""
    lin_vel_threshold: float = 0.8
    """Success needs this share of the maximum of the window's mean linear-velocity reward [-]."""
    ang_vel_threshold: float = 0.4
    """... of the yaw rate's reward [-] (HugWBC 2)."""
    contact_force_threshold: float = 0.8
    """... of 1 minus the mean penalty of both feet's contact force [-] (HugWBC 2)."""
    contact_vel_threshold: float = 0.8
    """... of 1 minus that of their contact velocity [-] (HugWBC 2)."""


@dataclass(frozen=True, kw_only=True)
class CommandsCfg:
    """The five commands (paper, Tab. command ranges; SI units)."""

    lin_vel_x: CommandRangeCfg = CommandRangeCfg(initial=(-0.3, 0.6), finishing=(-0.6, 1.2))
    """v_x, forward in the base frame [m/s] (paper)."""
    lin_vel_y: CommandRangeCfg = CommandRangeCfg(initial=(-0.5, 0.5), finishing=(-0.4, 0.4))
    """v_y, left in the base frame [m/s] (paper)."""
    ang_vel_z: CommandRangeCfg = CommandRangeCfg(initial=(-0.5, 0.5), finishing=(-1.0, 1.0))
    """omega, left turn [rad/s] (paper)."""
    base_height: CommandRangeCfg = CommandRangeCfg(initial=(-0.3, 0.0), finishing=(-0.3, 0.0))
    """h, from the robot's nominal height [m] (paper)."""
    body_pitch: CommandRangeCfg = CommandRangeCfg(initial=(-0.3, 0.5), finishing=(-0.3, 0.5))
    """p, forward [rad] (paper)."""
    resampling_time_s: float = 10.0
    """Time between draws [s]; commands are also drawn at reset (HugWBC 2)."""
    redraw_after_fall: bool = True
    """Whether a fall ends a command's time (HugWBC 2). Off, the robot gets up under the same command: what it fails at
    then takes as much time as what it can do (ours: else a robot that falls in 3 s stands in 3 % of its time)."""
    standing_probability: float = 0.1
    """Share of draws with zero velocity [-] (HugWBC 2)."""
    upright_probability: float = 0.0
    """Share of draws with zero height and pitch [-]: a robot is mostly driven so, but it is a corner of the ranges that
    uniform draws hardly come near (docs/experiments.md, 29) (ours)."""
    lin_vel_dead_zone: float = 0.15
    """Planar speed at or under which v_x and v_y become zero [m/s] (HugWBC 2)."""
    ang_vel_dead_zone: float = 0.15
    """Yaw rate at or under which omega becomes zero [rad/s] (HugWBC 2)."""
    curriculum: CommandCurriculumCfg = field(default_factory=CommandCurriculumCfg)


@dataclass(frozen=True, kw_only=True)
class GaitCfg:
    """Gait clock and swing target."""

    frequency: float = 1.5
    """Steps of one foot per second [Hz]; not in the paper's command (ours: nearest to the public gaits of all five)."""
    leg_scaling: float = 0.0
    """How much quicker short legs step: H1 has this frequency, others (0.87 m / leg length) to this power times it.
    0 is one clock for all, 0.5 the dynamic similarity of walking animals, an equal Froude number (ours)."""
    phase_offset: float = 0.5
    """Phase of the left foot ahead of the right [-]; 0.5 walks (HugWBC 1)."""
    stance_ratio: float = 0.5
    """Share of the cycle a foot is to be on the ground [-] (HugWBC 1)."""
    contact_smoothing: float = 0.05
    """Standard deviation of the edges of C(phi) [cycles] (HugWBC 1)."""


@dataclass(frozen=True, kw_only=True)
class NoiseCfg:
    """Half widths of the uniform sensor noise, in physical units (HugWBC 5)."""

    base_ang_vel: float = 0.2
    """[rad/s]"""
    projected_gravity: float = 0.05
    """[-]"""
    joint_pos: float = 0.01
    """[rad]"""
    joint_vel: float = 1.5
    """[rad/s]"""


@dataclass(frozen=True, kw_only=True)
class ObservationScalesCfg:
    """Factors that bring each observation near unit variance (ours; fixed, so there is no normalizer to drift)."""

    base_ang_vel: float = 0.5
    projected_gravity: float = 3.0
    joint_pos: float = 2.0
    joint_vel: float = 0.1
    last_action: float = 0.5
    command: tuple[float, float, float, float, float] = (2.0, 3.0, 2.0, 6.0, 3.0)
    base_lin_vel: float = 2.0
    height_error: float = 5.0
    foot_clearance: float = 10.0
    foot_force: float = 0.005
    """Applied to force [N] times 33 kg / robot mass, so that robots of all weights look alike."""
    height_scan: float = 5.0


@dataclass(frozen=True, kw_only=True)
class ObservationsCfg:
    """What actor and critic see (paper, Sec. Embodiment-aware Observation; HugWBC 5)."""

    history_length: int = 5
    """K, proprioceptive frames in s_t, newest first [-] (paper)."""
    last_action: bool = True
    """Whether the previous action is part of a frame (HugWBC 5; the paper does not name it)."""
    clock_harmonics: int = 0
    """Multiples of the gait's frequency that actor and critic see, sine and cosine each [-]; 0 is the sine of each
    foot's phase alone (paper). A policy's root may have seen fewer: what is new begins with weights of zero."""
    embodiment_observation: bool = True
    """Off is the paper's "w/o EO": o_ea leaves critic, estimator and loss."""
    descriptor: Literal["paper", "extended"] = "paper"
    """``extended`` adds limb lengths, joint axes and tree structure to o_ea (the paper's own outlook)."""
    enable_corruption: bool = True
    """Sensor noise on the actor's frames; the critic is never corrupted."""
    noise: NoiseCfg = field(default_factory=NoiseCfg)
    scales: ObservationScalesCfg = field(default_factory=ObservationScalesCfg)
    clip: float = 100.0
    """Bound on every observation [-] (HugWBC 5)."""
    scan_x: tuple[float, float, int] = (-0.42, 0.70, 9)
    """Height scan, forward: first, last [m], number of points (HugWBC 5: 17 points at 0.07 m; ours: every second)."""
    scan_y: tuple[float, float, int] = (-0.42, 0.42, 7)
    """Height scan, left: first, last [m], number of points."""


@dataclass(frozen=True, kw_only=True)
class RewardWeightsCfg:
    """Coefficients of the paper's reward table, then the terms it inherits without printing them (HugWBC 4).

    What a weight multiplies is the function of its name in ``envs/mdp/rewards.py``, with its unit. The product is
    multiplied by the control step, 0.02 s (HugWBC 0, item 1).
    """

    lin_vel_tracking: float = 2.0
    ang_vel_tracking: float = 2.5
    base_height: float = -60.0
    body_pitch: float = -1.0
    foot_swing: float = -30.0
    contact_vel: float = -1.0
    contact_force: float = -1.0
    roll_pitch_rate: float = -0.1
    vertical_speed: float = -2.0
    foot_slip: float = -0.1
    action_rate: float = -2e-3
    action_smoothness: float = -2e-3
    joint_torque: float = -1e-5
    joint_acceleration: float = -5e-8
    upper_deviation: float = -5.0
    hip_deviation: float = -0.4
    base_orientation: float = -5.0
    termination: float = -200.0
    """Inherited: the text penalises falls, the table has no row for it."""
    alive: float = 0.2
    """Inherited."""
    joint_limits: float = -10.0
    """Inherited: radians beyond the soft limits, for the hardware's sake."""
    landing: float = 0.0
    """Speed of a foot about to touch down, which turns the pelvis (ours, a penalty)."""


@dataclass(frozen=True, kw_only=True)
class RewardsCfg:
    """Reward terms and their shapes."""

    weights: RewardWeightsCfg = field(default_factory=RewardWeightsCfg)
    orientation: Literal["upright", "commanded"] = "commanded"
    """``upright`` is the printed table, where base orientation fights the pitch command; ``commanded`` measures
    orientation against the commanded pitch, so that robots lean."""
    tracking_kappa: float = 0.25
    """kappa of both velocity-tracking terms [m^2/s^2, rad^2/s^2] (paper)."""
    standing_kappa: float = 0.25
    """kappa of a second kernel that makes up half of both terms while all velocity commands are zero. Narrower than the
    first, it rewards standing still at once; drifting at 0.1 m/s costs the first 4 % and ends in a fall (ours)."""
    walking_kappa: float = 0.25
    """The same while any velocity is commanded: the first kernel draws a robot near its command, the second goes on
    paying for the last tenths (ours)."""
    contact_vel_kappa: float = 5.0
    """[m^2/s^2] (paper)."""
    contact_force_kappa: float = 50.0
    """[N^2] (paper)."""
    foot_slip_kappa: float = 1.0
    """[m^2/s^2] (paper)."""
    foot_swing_clip: float = 0.1
    """Bound on the summed squared swing error [m^2] (HugWBC 4)."""
    landing_height: float = 0.05
    """Height of a sole at which ``landing`` counts for 1/e of what it does on the ground [m] (ours)."""
    soft_limit_ratio: float = 0.9
    """Share of the joint range inside which ``joint_limits`` is zero [-] (HugWBC 4)."""
    penalty_initial: float = 0.2
    """k at the start: factor on the penalties marked (k) (HugWBC 4)."""
    penalty_exponent: float = 0.8
    """k <- k ** exponent at each update."""
    penalty_interval_steps: int = 2400
    """Control steps between updates of k: 100 iterations of 24 steps (HugWBC 4)."""


@dataclass(frozen=True, kw_only=True)
class TerminationsCfg:
    """When an episode ends (HugWBC 9)."""

    episode_length_s: float = 20.0
    """Time limit [s]."""
    max_roll: float = 0.8
    """[rad]"""
    max_pitch: float = 1.0
    """[rad]"""
    ground_contact: bool = True
    """End when torso, pelvis or head touch the ground."""


@dataclass(frozen=True, kw_only=True)
class RandomizationCfg:
    """Domain randomization, per environment (HugWBC 8). A range of (1, 1) or (0, 0) switches one row off."""

    enabled: bool = True
    """Master switch of everything in this group."""
    friction: Range = (0.55, 1.875)
    """Effective friction coefficient [-], each reset."""
    stiffness_scale: Range = (0.8, 1.2)
    """Factor on kp per joint, each reset."""
    damping_scale: Range = (0.8, 1.2)
    """Factor on kd per joint, each reset."""
    strength_scale: Range = (0.8, 1.2)
    """Factor on kp and kd together per joint, each reset."""
    motor_offset: Range = (-0.02, 0.02)
    """Offset of the PD target per joint [rad], each reset."""
    sensing_latency_s: Range = (0.0, 0.02)
    """Age of the proprioception [s], per environment, each reset; at most a control step."""
    link_mass_scale: Range = (0.8, 1.2)
    """Factor on each link's mass and inertia, at creation."""
    link_com_offset: Range = (-0.01, 0.01)
    """Shift of each link's centre of mass per axis [m], at creation."""
    base_mass_ratio: Range = (-0.058, 0.174)
    """Mass added to the base as a share of the robot's mass, at creation."""
    base_com_offset: Range = (-0.03, 0.03)
    """Shift of the base's centre of mass in x and y [m], at creation."""
    push_interval_s: float = 5.0
    """Time between pushes [s]."""
    push_lin_vel: float = 0.6
    """Half width of the velocity added per axis [m/s], times k."""
    push_ang_vel: float = 0.6
    """Half width of the angular velocity added per axis [rad/s], times k."""
    init_joint_scale: Range = (0.5, 1.5)
    """Factor on the default joint angles at reset."""
    init_joint_vel: Range = (-1.0, 1.0)
    """Joint velocity at reset [rad/s]."""
    init_root_vel: Range = (-0.5, 0.5)
    """Root linear [m/s] and angular [rad/s] velocity per axis at reset."""
    morphology_length_scale: Range = (1.0, 1.0)
    """Factor on link lengths, inertia following by its square, mass not (ours, off: the paper's outlook)."""
    morphology_mass_scale: Range = (1.0, 1.0)
    """Factor on the mass of the whole body (ours, off)."""


@dataclass(frozen=True, kw_only=True)
class AidsCfg:
    """Learning aids, per robot, annealed to exactly zero and off in evaluation (ours)."""

    harness: float = 1.0
    """Start scale of the virtual harness on the base [-]; 0 is off."""
    harness_decay: float = 0.02
    """Relative decay per ``interval_steps`` while episodes are long."""
    gait_shaping: float = 1.0
    """Start scale s of the softened contact kernel, kappa = 50 + 1e4 s for 33 kg, weights x (1 + 2 s); 0 is off."""
    gait_shaping_decay: float = 0.02
    """Relative decay of gait shaping per ``interval_steps`` while contacts match the clock."""
    interval_steps: int = 24
    """Control steps between updates of both scales, and between entries in the environment's log."""
    min_episode_ratio: float = 0.6
    """The harness decays while the mean episode lasts this share of its full length."""
    harness_return_ratio: float = 0.4
    """It grows again, at that rate, while the mean episode is shorter than this share; 0 is never."""
    harness_contact_match: float = 0.7
    """... and while foot contacts match the clock this often; dropped earlier, robots stand and never step."""
    min_contact_match: float = 0.8
    """Gait shaping decays while foot contacts match the clock this often."""


@dataclass(frozen=True, kw_only=True)
class TaskCfg:
    """The Markov decision process."""

    sim: SimCfg = field(default_factory=SimCfg)
    terrain: TerrainCfg = field(default_factory=TerrainCfg)
    control: ControlCfg = field(default_factory=ControlCfg)
    commands: CommandsCfg = field(default_factory=CommandsCfg)
    gait: GaitCfg = field(default_factory=GaitCfg)
    observations: ObservationsCfg = field(default_factory=ObservationsCfg)
    rewards: RewardsCfg = field(default_factory=RewardsCfg)
    terminations: TerminationsCfg = field(default_factory=TerminationsCfg)
    randomization: RandomizationCfg = field(default_factory=RandomizationCfg)
    aids: AidsCfg = field(default_factory=AidsCfg)
