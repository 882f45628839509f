"""Mistakes in the mathematics, each one that a tired author could make: signs, indices, slots, coefficients, masks.

A mutant replaces ``old``, which occurs once in its file, by ``new``; one of its ``tests`` must then fail.
"""

from __future__ import annotations

from typing import NamedTuple


class Mutant(NamedTuple):
    """One mistake."""

    file: str
    old: str
    new: str
    tests: str
    """Test files under ``tests``, separated by blanks."""


REWARDS = "envs/mdp/rewards.py"
GAIT = "envs/mdp/gait.py"
OBSERVATIONS = "envs/mdp/observations.py"
LAYOUT = "envs/mdp/layout.py"
COMMANDS = "envs/mdp/commands.py"
GEOMETRY = "envs/geometry.py"
SLOTS = "envs/robots/slots.py"
CONSISTENCY = "envs/robots/consistency.py"
EMBODIMENT = "envs/robots/embodiment.py"
POOLING = "envs/pooling.py"
STAGING = "envs/sim/staging.py"
HEALTH = "envs/sim/health.py"
PHYSICS_POOL = "envs/sim/pool.py"
HUMANOID_ENV = "envs/humanoid_env.py"
STEP_LOG = "envs/step_log.py"
AIDS = "envs/mdp/aids.py"
POSTURE = "envs/robots/posture.py"
RESTING = "envs/mdp/posture.py"
SEARCH = "eagle_rl/algorithms/search.py"
SEARCHING = "eagle_rl/runners/searching.py"
CORRECTION = "eagle_rl/models/correction.py"
FORESIGHT = "eagle_rl/models/foresight.py"
FORESEEING = "eagle_rl/algorithms/foresight.py"
CORRECTING = "eagle_rl/algorithms/correction.py"
CORRECTING_RUNNER = "eagle_rl/runners/correcting.py"
FEEDBACK = "eagle_rl/algorithms/feedback.py"
TRIALS = "eagle_rl/evaluation/trials.py"
FALLS = "eagle_rl/evaluation/falls.py"
LOSSES = "eagle_rl/algorithms/losses.py"
GAUSSIAN = "eagle_rl/models/distribution.py"
PPO = "eagle_rl/algorithms/eagle_ppo.py"
ENV = "envs/humanoid_env.py"
CONTROL_STEP = "envs/control_step.py"
RECORDING = "envs/recording.py"
TERMS = "eagle_rl/algorithms/terms.py"
ACTOR = "eagle_rl/models/actor.py"
SHARING = "eagle_rl/algorithms/sharing.py"
GRADIENT = "eagle_rl/algorithms/gradient.py"
THREADS = "eagle_rl/threads.py"
KERNELS = "eagle_rl/kernels.py"
PRECISION = "eagle_rl/models/precision.py"

REWARD_TESTS = "mdp/test_rewards.py"
LEARNER_TESTS = "learner/test_eagle_ppo.py"
STATE_TESTS = "envs/test_measure.py"

MUTANTS: tuple[Mutant, ...] = (
    # rewards
    Mutant(REWARDS, "exp(squared_error / -kappa)", "exp(squared_error / -(kappa * kappa))", REWARD_TESTS),
    Mutant(REWARDS, "command[:, :2] - state.base_lin_vel_b", "command[:, :2] + state.base_lin_vel_b", REWARD_TESTS),
    Mutant(REWARDS, "- state.base_ang_vel_b[:, 2])", "- state.base_ang_vel_b[:, 1])", REWARD_TESTS),
    Mutant(REWARDS, "nominal_height + state.command[:, 3]", "nominal_height - state.command[:, 3]", REWARD_TESTS),
    Mutant(REWARDS, "state.command[:, 4] - state.base_pitch", "state.command[:, 4] + state.base_pitch", REWARD_TESTS),
    Mutant(REWARDS, "swing = 1.0 - ctx.once(", "swing = ctx.once(", REWARD_TESTS),
    Mutant(REWARDS, "_square_sum(state.foot_force_w)", "_square_sum(state.foot_force_w[..., :2])", REWARD_TESTS),
    Mutant(REWARDS, "state.foot_contact | state.last", "state.foot_contact & state.last", REWARD_TESTS),
    Mutant(
        REWARDS, "_square_sum(state.base_ang_vel_b[:, :2])", "_square_sum(state.base_ang_vel_b[:, 1:])", REWARD_TESTS
    ),
    Mutant(REWARDS, "alpha=-2.0", "alpha=-1.0", REWARD_TESTS),
    Mutant(REWARDS, "gravity_x - torch.sin", "gravity_x + torch.sin", REWARD_TESTS),
    Mutant(REWARDS, "* step_dt * (penalty_scale if", "* (penalty_scale if", REWARD_TESTS),
    Mutant(REWARDS, "1.0 - 0.5 * _swing_load", "1.0 - _swing_load", REWARD_TESTS),
    Mutant(REWARDS, "cfg.standing_kappa, cfg.walking_kappa)", "cfg.walking_kappa, cfg.standing_kappa)", REWARD_TESTS),
    Mutant(POSTURE, "signs[self._index] * bend", "signs[self._index] * -bend", "robots/test_posture.py"),
    Mutant(POSTURE, "(0.0, np.sin(pitch / 2)", "(0.0, -np.sin(pitch / 2)", "robots/test_posture.py"),
    Mutant(POSTURE, "bend + step, self._lower, self._upper", "bend + step, -9, 9", "robots/test_posture.py"),
    Mutant(RESTING, "(self._share * self.followed)", "(self.followed)", "mdp/test_posture.py"),
    Mutant("eagle_rl/export/runtime.py", "posture.share * self._followed", "self._followed", "export/test_export.py"),
    Mutant(RESTING, "-step_dt / cfg.posture_time_constant", "-cfg.posture_time_constant", "mdp/test_posture.py"),
    Mutant(
        "envs/mdp/curriculum.py", "penalty_exponent**updates", "penalty_exponent * updates", "mdp/test_curriculum.py"
    ),
    # gait
    Mutant(
        GAIT,
        "(torch.remainder(phase + cfg.phase_offset, 1.0), phase)",
        "(phase, torch.remainder(phase + cfg.phase_offset, 1.0))",
        "mdp/test_gait.py",
    ),
    Mutant(GAIT, "(0.0, 0.5, 1.0, 1.5)", "(0.0, 0.5, 0.9, 1.5)", "mdp/test_gait.py"),
    Mutant(GAIT, "6.0 * rise - 15.0", "6.0 * rise - 14.0", "mdp/test_gait.py"),
    Mutant(GAIT, "STANDING_PHASE = 0.25", "STANDING_PHASE = 0.75", "mdp/test_gait.py"),
    # frames and the pooled state
    Mutant(GEOMETRY, "vector - w * t", "vector + w * t", STATE_TESTS),
    Mutant(GEOMETRY, "torch.addcmul(c * y, s, x, value=-1.0)", "torch.addcmul(c * y, s, x)", STATE_TESTS),
    Mutant(GEOMETRY, "torch.addcmul(w * z, x, y)", "torch.addcmul(w * z, x, y, value=-1.0)", STATE_TESTS),
    Mutant("envs/measure.py", "(0.0, 0.0, -1.0)", "(0.0, 0.0, 1.0)", STATE_TESTS),
    Mutant(
        "envs/state.py", "atan2(-self.projected_gravity_b[:, 1]", "atan2(self.projected_gravity_b[:, 1]", STATE_TESTS
    ),
    # slots and mirror
    Mutant(SLOTS, '_SIDES = ("right", "left")', '_SIDES = ("left", "right")', "robots/test_slots.py"),
    Mutant(CONSISTENCY, "turns[index - 1] *= -1.0", "turns[index - 1] *= 1.0", "robots/test_slots.py"),
    Mutant(CONSISTENCY, "spec.signs[:, None] * ", "", "robots/test_slots.py"),
    Mutant(SLOTS, 'name.endswith("_pitch") else', 'name.endswith("_roll") else', "robots/test_slots.py"),
    Mutant(
        LAYOUT,
        "AXIAL = Mirror.keep(-1.0, 1.0, -1.0)",
        "AXIAL = Mirror.keep(1.0, -1.0, 1.0)",
        "mdp/test_symmetry.py",
    ),
    Mutant(LAYOUT, "1.0, 1.0, 1.0, -1.0, 1.0, -1.0)", "1.0, 1.0, 1.0, -1.0, -1.0, 1.0)", "robots/test_embodiment.py"),
    Mutant(
        "envs/robots/spec.py",
        "self.signs * (joint_pos - self.zero",
        "self.signs * (joint_pos + self.zero",
        "robots/test_slots.py",
    ),
    Mutant(POOLING, "0.5 * ratio * (upper - lower)", "ratio * (upper - lower)", "envs/test_pooling.py"),
    Mutant(POOLING, "spec.effort_limit / spec.stiffness", "spec.stiffness / spec.effort_limit", "envs/test_pooling.py"),
    Mutant(STAGING, "position - conv", "position + conv", "envs/test_physics.py"),
    Mutant(STAGING, "force - damping", "force + damping", "envs/test_physics.py"),
    Mutant(STAGING, "* chosen + conv", "* chosen - conv", "envs/test_physics.py"),
    Mutant(HEALTH, "size <= largest", "size < largest", "envs/test_health.py"),
    Mutant(HEALTH, 'MAX_SPEED, "velocity"', 'MAX_SPEED, "distance"', "envs/test_health.py"),
    Mutant(HEALTH, "code.clamp(max=", "code.clamp(min=", "envs/test_health.py"),
    Mutant(PHYSICS_POOL, 'np.seterr(over="ignore")', 'np.seterr(over="warn")', "envs/test_threads.py"),
    Mutant(PHYSICS_POOL, "self.causes.unsqueeze(1) > 0", "self.causes.unsqueeze(1) < 0", "envs/test_health.py"),
    Mutant(CONTROL_STEP, "in (dones, cut, due, sick)", "in (cut, dones, due, sick)", "envs/test_humanoid_env.py"),
    Mutant(CONTROL_STEP, "self._step_count + 1", "self._step_count + 2", "envs/test_humanoid_env.py"),
    Mutant(
        PHYSICS_POOL,
        "self.staged_before.index_copy(0, ids, rows)",
        "self.staged_before.index_copy(0, ids, 0 * rows)",
        "envs/test_humanoid_env.py",
    ),
    Mutant(
        PHYSICS_POOL,
        "self.staged_before = self.staged\n        self.staged = torch.cat",
        "self.staged = torch.cat",
        "envs/test_physics.py envs/test_humanoid_env.py",
    ),
    Mutant(HUMANOID_ENV, "self.common_step_counter % self._stagger", "0", "envs/test_humanoid_env.py"),
    Mutant(HUMANOID_ENV, "group[ids] = rows", "group[ids] = group[ids]", "envs/test_humanoid_env.py"),
    Mutant(HUMANOID_ENV, "self.pool.staged = self.pool.staged.clone()", "pass", "envs/test_humanoid_env.py"),
    Mutant(HUMANOID_ENV, "penalty_interval_steps == 0:", "penalty_interval_steps == 1:", "envs/test_humanoid_env.py"),
    Mutant(STEP_LOG, "x + block.to(x.dtype)", "block.to(x.dtype)", "envs/test_health.py"),
    Mutant(RECORDING, "else count + kept.index(i)", "else kept.index(i)", "envs/test_recording.py"),
    Mutant(RECORDING, "else x[:count]", "else x[-count:]", "envs/test_recording.py"),
    Mutant(KERNELS, "(*node.args[:4], True,", "(*node.args[:4], False,", "test_kernels.py"),
    Mutant(KERNELS, "or not _same(results, made)", "", "test_kernels.py"),
    Mutant(KERNELS, "[*constants, *tensors]", "[*tensors, *constants]", "test_kernels.py"),
    Mutant(KERNELS, "(product, negative)", "(negative, product)", "test_kernels.py"),
    Mutant(PRECISION, "and not _is_intels", "and _is_intels", "learner/test_precision.py"),
    Mutant(GRADIENT, "if id(p) in actors", "if id(p) not in actors", LEARNER_TESTS),
    Mutant("envs/sim/batch.py", "env=self.first_env + env", "env=env", "envs/test_threads.py"),
    # observations
    Mutant(
        OBSERVATIONS, "state.joint_pos - robots.default", "state.joint_pos + robots.default", "mdp/test_observations.py"
    ),
    Mutant(OBSERVATIONS, "(2.0 / (high - low)) - 1.0", "(2.0 / (high - low))", "mdp/test_observations.py"),
    Mutant(
        OBSERVATIONS,
        "torch.lerp(current[:, :SENSED_SIZE], previous[:, :SENSED_SIZE], fraction)",
        "torch.lerp(previous[:, :SENSED_SIZE], current[:, :SENSED_SIZE], fraction)",
        "mdp/test_observations.py",
    ),
    Mutant(
        OBSERVATIONS,
        "torch.cat((*columns, self.flat[:, :-width]), dim=1)",
        "torch.cat((self.flat[:, :-width], *columns), dim=1)",
        "mdp/test_observations.py",
    ),
    Mutant(EMBODIMENT, "scale * length.square()", "scale * length", "robots/test_embodiment.py"),
    Mutant(EMBODIMENT, "rows[[0, 2, 1]]", "rows[[0, 1, 2]]", "robots/test_embodiment.py"),
    # commands, aids, errors
    Mutant(COMMANDS, "mean > self._thresholds", "mean < self._thresholds", "mdp/test_commands.py"),
    Mutant(COMMANDS, "wins @ self._grid.neighbours", "wins", "mdp/test_commands.py"),
    Mutant(COMMANDS, "command[:, 3:] = command[:, 3:]", "command[:, 2:] = command[:, 2:]", "mdp/test_commands.py"),
    Mutant("eagle_rl/runners/following.py", ", NUM_VELOCITIES:] = 0.0", ", :] = 0.0", "runners/test_correcting.py"),
    Mutant("eagle_rl/runners/following.py", "draw * upright // 2", "draw * upright", "runners/test_correcting.py"),
    Mutant(ACTOR, 'self.sides.mirrored("actions", head(', "(head(", "learner/test_actor.py"),
    Mutant(ACTOR, "self.sides.mirrored(group, x) for", "x for", "learner/test_actor.py"),
    Mutant(ACTOR, "0.5 * (mean +", "0.5 * (mean -", "learner/test_actor.py"),
    Mutant("eagle_rl/models/sides.py", ' * getattr(self, f"{group}_sign")', "", "learner/test_actor.py"),
    Mutant(
        COMMANDS,
        "(planar[:, :1], others[:, :1], planar[:, 1:], others[:, 1:])",
        "(planar[:, 1:], others[:, :1], planar[:, :1], others[:, 1:])",
        "mdp/test_commands.py",
    ),
    Mutant(AIDS, "_HEIGHT_STIFFNESS * sag", "_HEIGHT_STIFFNESS * -sag", "mdp/test_aids.py"),
    Mutant(AIDS, "torch.where(falls, returned,", "torch.where(falls, self.harness,", "mdp/test_aids.py"),
    Mutant(
        "envs/mdp/terminations.py",
        "state.base_roll.abs() > cfg.max_roll",
        "state.base_roll > cfg.max_roll",
        "mdp/test_terminations.py",
    ),
    Mutant("envs/mdp/metrics.py", "state.base_height - robots", "state.base_height + robots", "mdp/test_metrics.py"),
    Mutant(
        "eagle_rl/evaluation/metrics.py",
        "self.charge += counted + absent",
        "self.charge += counted",
        "evaluation/test_evaluate.py",
    ),
    # learner
    Mutant(LOSSES, "* mask).sum(dim=1) / live", "* mask).mean(dim=1)", "learner/test_losses.py"),
    Mutant(LOSSES, "mean_of_mirrored[:, perm] * sign", "mean_of_mirrored[:, perm]", "learner/test_losses.py"),
    Mutant(
        LOSSES,
        "error[:, BASE_VELOCITY_DIM:].mean(dim=1)",
        "error[:, BASE_VELOCITY_DIM + 1 :].mean(dim=1)",
        "learner/test_losses.py",
    ),
    Mutant(
        GAUSSIAN,
        "- std.log() - _LOG_SQRT_2_PI) * mask)",
        "- std.log() - _LOG_SQRT_2_PI))",
        "learner/test_distribution.py",
    ),
    Mutant(GAUSSIAN, "0.5 + _LOG_SQRT_2_PI) * mask)", "_LOG_SQRT_2_PI) * mask)", "learner/test_distribution.py"),
    Mutant(GAUSSIAN, "(old_std / std).square()", "(std / old_std).square()", "learner/test_distribution.py"),
    Mutant("eagle_rl/algorithms/valuing.py", "gamma * value", "value", LEARNER_TESTS),
    Mutant(PPO, "dones = dones.index_fill(0, ids, 1)", "dones = dones.clone()", LEARNER_TESTS),
    Mutant(CONTROL_STEP, "time_outs | (surprised & ~dones)", "time_outs", "envs/test_humanoid_env.py"),
    Mutant(
        PPO, "self.learning_rate / LEARNING_RATE_FACTOR", "self.learning_rate * LEARNING_RATE_FACTOR", LEARNER_TESTS
    ),
    Mutant(
        TERMS,
        'share["teacher_action"], share["teacher_std"], policy.mean, std',
        'policy.mean, std, share["teacher_action"], share["teacher_std"]',
        LEARNER_TESTS,
    ),
    Mutant(TERMS, "torch.exp(-self.decay", "torch.exp(self.decay", LEARNER_TESTS),
    Mutant(
        TERMS,
        "self.alpha * action + self.beta * embedding",
        "self.beta * action + self.alpha * embedding",
        LEARNER_TESTS,
    ),
    Mutant(
        "eagle_rl/algorithms/specialists.py",
        "zip(self.specialists, self.corrections",
        "zip(self.specialists[::-1], self.corrections",
        LEARNER_TESTS,
    ),
    Mutant(LOSSES, "action / (teacher_std + 1 - mask)", "action * (teacher_std + 1 - mask)", LEARNER_TESTS),
    Mutant(
        SEARCH,
        "self.parameters + step, self.parameters - step",
        "self.parameters - step, self.parameters + step",
        "learner/test_search.py",
    ),
    Mutant(
        "eagle_rl/runners/training.py",
        "torch.lerp(x, weights[name], share)",
        "torch.lerp(weights[name], x, share)",
        "runners/test_stages.py",
    ),
    Mutant(CORRECTION, "SHIFT_UNIT * coefficients", "coefficients", "learner/test_correction.py"),
    Mutant(CORRECTION, " + extra) * walks", " + extra)", "learner/test_correction.py"),
    Mutant(CORRECTION, "extra_actions) * walks", "extra_actions)", "learner/test_correction.py"),
    Mutant(CORRECTION, 'obs["phase"], basis) * walks', 'obs["phase"], basis)', "learner/test_foresight.py"),
    Mutant(FORESIGHT, "self.damping.square()", "self.damping", "learner/test_foresight.py"),
    Mutant(FORESIGHT, "return -(answer", "return (answer", "learner/test_foresight.py"),
    Mutant(FORESIGHT, ".clamp(-MAX_CHANGE, MAX_CHANGE)", "", "learner/test_foresight.py"),
    Mutant(FORESEEING, "phase=self.phase + 0.5", "phase=self.phase", "learner/test_foresight.py"),
    Mutant(
        FORESEEING, "trace.error[h : h + steps]", "trace.error[horizon - 1 - h :][:steps]", "learner/test_foresight.py"
    ),
    Mutant(
        CORRECTING_RUNNER,
        "best = costs.index(min(costs))\n        how",
        "best = 1\n        how",
        "runners/test_correcting.py",
    ),
    Mutant(CORRECTION, "self.yaw_scales[0] - command", "self.yaw_scales[0] + command", "learner/test_correction.py"),
    Mutant(FEEDBACK, "turned = -half_a_cycle", "turned = half_a_cycle", "learner/test_feedback.py"),
    Mutant(FEEDBACK, "downhill = -symmetric", "downhill = symmetric", "learner/test_feedback.py"),
    Mutant(CORRECTING_RUNNER, "0.5 * (more.cost - less.cost)", "more.cost", "runners/test_correcting.py"),
    Mutant(
        "eagle_rl/runners/root.py", "pad(weights, (0, columns))", "pad(weights, (columns, 0))", "runners/test_root.py"
    ),
    Mutant("envs/mdp/gait.py", ".flatten(1)[:, 2:]", ".flatten(1)[:, :-2]", "mdp/test_gait.py"),
    Mutant(CORRECTION, ".clamp(-1.0, 1.0)", "", "learner/test_correction.py"),
    Mutant(
        CORRECTING, "* half_a_cycle(NUM_HARMONICS)", "* waves(sign, NUM_HARMONICS)[0]", "learner/test_correction.py"
    ),
    Mutant(CORRECTION, "/ -DOUBT", "/ DOUBT", "learner/test_correction.py"),
    Mutant(CORRECTING, "command[:, perm] * sign)))", "command[:, perm])))", "learner/test_correction.py"),
    Mutant(CORRECTING, "harm.clamp(-MAX_HARM, MAX_HARM)", "harm", "learner/test_correction.py"),
    Mutant(CORRECTING_RUNNER, "cost - old, mirror", "old - cost, mirror", "runners/test_correcting.py"),
    Mutant(CORRECTING, "return -effect @", "return effect @", "learner/test_correction.py"),
    Mutant(CORRECTING, "found[..., 1:] *= ", "found[..., 2:] *= ", "learner/test_correction.py"),
    Mutant(
        CORRECTING_RUNNER,
        "0.5 * (more.waves - less.waves)",
        "0.5 * (less.waves - more.waves)",
        "runners/test_correcting.py",
    ),
    Mutant(SEARCHING, "cost[1] - cost[0]", "cost[0] - cost[1]", "runners/test_searching.py"),
    Mutant(SEARCH, "better.clamp(-bound, bound)", "better", "learner/test_search.py"),
    Mutant(SEARCH, "- weight @ self.mean", "", "learner/test_search.py"),
    Mutant(SEARCH, "noise + self.sign * noise", "noise + noise", "learner/test_search.py"),
    Mutant(SEARCH, "parity.abs() > MIN_PARITY", "parity.abs() >= 0.0", "learner/test_search.py"),
    Mutant(
        FALLS,
        "(_, at_stop) = self._recent[-1], self._recent[0]",
        "(_, at_stop) = self._recent[-1], self._recent[-1]",
        "evaluation/test_falls.py",
    ),
    Mutant(FALLS, '"left" if left > 0', '"left" if left < 0', "evaluation/test_falls.py"),
    Mutant(FALLS, "time_s=(step + 1)", "time_s=step", "evaluation/test_falls.py"),
    Mutant(TRIALS, "(disturbed, True)", "(disturbed, False)", "evaluation/test_trials.py"),
    Mutant(
        TRIALS,
        "torch.where(fell.unsqueeze(1), self._fallen_errors, ",
        "torch.where(fell.unsqueeze(1), 0.0, ",
        "evaluation/test_trials.py",
    ),
    Mutant(TRIALS, "t >= self._cfg.settling_steps", "t > self._cfg.settling_steps", "evaluation/test_trials.py"),
    Mutant(PPO, "(last / first) ** min", "(first / last) ** min", LEARNER_TESTS),
    Mutant(LOSSES, "return -torch.min(ratio", "return -torch.max(ratio", "learner/test_losses.py"),
    Mutant(GRADIENT, "torch.add(first, others[0],", "torch.add(first, first,", "learner/test_sharing.py"),
    Mutant(GRADIENT, "if norm > max_norm:", "if sum(norms) > max_norm:", LEARNER_TESTS),
    Mutant(TERMS, "self.coef * rows.sum() / everyone", "self.coef * rows.sum() / own", "learner/test_sharing.py"),
    Mutant("envs/robots/posture.py", "BALANCE_MARGIN = 0.04", "BALANCE_MARGIN = 40.0", "robots/test_posture.py"),
    Mutant(TERMS, "self.sides.mirrored(g, share[g][:own])", "share[g][:own]", LEARNER_TESTS),
    Mutant(SHARING, "range(self.index, rows, self.count)", "range(0, rows, self.count)", "learner/test_rollout.py"),
    Mutant(SHARING, "*(p.detach() for p in parameters)", "*inputs[: len(wanted)]", "learner/test_sharing.py"),
    Mutant(THREADS, "while errand.take_place():", "while False:", "test_threads.py"),
    Mutant(THREADS, "results[i] for i in range(len(tasks))", "results[i] for i in results", "test_threads.py"),
    Mutant(CONTROL_STEP, '"_noise_keys", ', "", "envs/test_recording.py"),
    Mutant(CONTROL_STEP, 'writes, *written), ("_state",)', "writes, *written), ()", "envs/test_recording.py"),
    Mutant(
        RECORDING,
        "x.clone(memory_format=torch.contiguous_format) for x, source",
        "x for x, source",
        "envs/test_recording.py",
    ),
)
