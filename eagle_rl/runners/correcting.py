"""The stage that answers the yaw rate's error and takes off what of all errors repeats with the gait, on one robot."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console
from torch import Tensor

from eagle_rl.algorithms.correction import Mirror, Probe, expected_harm, improve
from eagle_rl.algorithms.feedback import descent, symmetric
from eagle_rl.algorithms.foresight import foresee
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import EagleWarning
from eagle_rl.evaluation.evaluate import MakeEnv
from eagle_rl.models.basis import monomials
from eagle_rl.models.correction import FEEDBACK_HARMONICS, NUM_HARMONICS, NUM_SHIFTS, YAW, Correction
from eagle_rl.models.sides import partners
from eagle_rl.runners import checkpoint as ckpt
from eagle_rl.runners.files import patiently
from eagle_rl.runners.following import Followers
from eagle_rl.runners.plan import Stage
from eagle_rl.runners.provenance import Provenance

SHARES = (1.0, 0.5)
"""Of a step that are tried: after a whole one a robot may fall."""
LENGTHS = (0.8, 0.4, 0.2, 0.1)
"""Changes of all gains together that are tried [s/rad]; the best of them is taken, beyond it the loop rings."""
DAMPINGS = (56.0, 28.0, 20.0, 14.0)
"""Of the foresight's answer that are tried; with 5 robots fall (docs/experiments.md, 26)."""
MIN_TRUSTED = 0.1
"""Share of the commands a pass must help at; with less it may well be chance that it seems to."""
MIN_SURVIVAL = 0.25
"""Share of robots that must have stayed up with a change, with its negative and without."""


class _TooFewStoodError(Exception):
    """Nothing can be learned of robots that fall."""


class CorrectionRunner:
    """Corrects the policy of a checkpoint, of whose learner nothing changes.

    It takes a few minutes an iteration and starts anew if it is stopped.
    """

    def __init__(
        self, cfg: ExperimentCfg, stage: Stage, init: Path, folder: Path, make_env: MakeEnv, provenance: Provenance
    ) -> None:
        """Take the learner of ``init``; write into ``folder``."""
        self.cfg, self.stage, self.folder, self.provenance = cfg, stage, folder, provenance
        self._learner = ckpt.load_checkpoint(init, provenance.slot_table_hash).state
        actor = ckpt.load_actor(init, cfg.run.env_device)[0]
        self._robots = Followers(cfg, actor, make_env, stage.seed)

    @torch.no_grad()
    def run(self, on_iteration: Callable[[], None] = lambda: None) -> Path:
        """Correct as often as the stage says, or until nothing gets better, then save.

        Returns:
            The checkpoint.
        """
        start = time.perf_counter()
        correction, mirror = self._begin()
        for iteration in range(self.stage.iterations if self.cfg.correction.std else 0):
            before, number = correction, 5 * iteration
            try:
                tuned = self._tune(before.with_pass(), mirror, number)
                correction = self._correct(before, tuned, mirror, number + 2)
            except _TooFewStoodError:
                reason = "most robots fell and taught nothing; a correction needs a policy that walks"
                warnings.warn(f"{self.stage.name}: {reason}.", EagleWarning, stacklevel=2)
                break
            on_iteration()
            if correction is before:
                break
        correction = self._foresee(correction, mirror, 5 * self.stage.iterations)
        return patiently(lambda: self._save(correction, time.perf_counter() - start))

    def _begin(self) -> tuple[Correction, Mirror]:
        """No correction yet, and the robot's mirror."""
        env = self._robots.env(2, self._robots.calm)
        env.pin_commands(self._robots.limits.T)
        obs = env.get_observations()
        low, high = obs["command"]
        slots = obs["slot_mask"][0].nonzero().flatten()
        perm, sign = env.mirror["actions"]
        scale = env.robots.action_scale[0, slots].to(low)  # a stiff joint's action is worth a small angle
        scales = self.cfg.task.observations.scales
        width, terms = len(slots) * (2 * NUM_HARMONICS + 1) + NUM_SHIFTS, monomials(obs["command"]).shape[1]
        correction = Correction(
            weights=low.new_zeros(0, terms, width),
            slots=slots,
            units=scale.log().mean().exp() / scale,
            middle=(low + high) / 2,
            half_range=(high - low) / 2,
            gains=low.new_zeros(0, len(slots), 2 * FEEDBACK_HARMONICS + 1),
            harm=low.new_zeros(0, terms),
            yaw_scales=low.new_tensor([scales.base_ang_vel, scales.command[YAW]]),
        )
        return correction, Mirror(command=env.mirror["command"], partner=partners(slots, perm), sign=sign[slots])

    def _tune(self, correction: Correction, mirror: Mirror, number: int) -> Correction:
        """The correction with the last gains, downhill of its own, with which commands not probed are followed best."""
        std, gains = self.cfg.correction.gain_std, correction.gains[-1]
        if not std:
            return correction
        shape = (self.cfg.correction.num_envs, *gains.shape)
        change = torch.randn(shape, generator=self._robots.generator(number)).to(gains)
        change = std * math.sqrt(2.0) * symmetric(change, mirror)  # of which both halves are alike
        more, less = (self._robots.follow(correction, number, gains=way * change) for way in (1.0, -1.0))
        stood = self._require_most(~(more.fell | less.fell))
        downhill = descent(change[stood], 0.5 * (more.cost - less.cost)[stood], mirror)
        candidates = [correction.last(gains=gains + length * downhill) for length in (0.0, *LENGTHS)]
        costs = [self._robots.follow(candidate, number + 1).cost.mean().item() for candidate in candidates]
        best = costs.index(min(costs))
        length = (0.0, *LENGTHS)[best]
        self._tell(f"cost {costs[0]:.3f} -> {costs[best]:.3f} with gains changed by {length:g}")
        return candidates[best]

    def _correct(self, before: Correction, tuned: Correction, mirror: Mirror, number: int) -> Correction:
        """One pass more than before, with its gains and a share of a step, where commands are followed better with it.

        That is seen at commands that were not probed, half of them in the world of training.
        """
        correcting = self.cfg.correction
        step = improve(tuned, self._probe(tuned, number), mirror, correcting.std, correcting.damping)
        trials = [tuned.last(weights=share * step) for share in SHARES]
        command, old, *new = self._costs([before, *trials], number + 1)
        harms = [expected_harm(before, command, cost - old, mirror) for cost in new]
        basis = monomials(before.normalised(command))
        changes = [(basis @ harm).clamp(max=0.0).mean().item() for harm in harms]
        best = changes.index(min(changes))
        trusted, cost = (basis @ harms[best] < 0).float().mean().item(), old.mean().item()
        outcome = f"cost {cost:.3f} -> {cost + changes[best]:.3f} expected with {SHARES[best]:.0%} of the step"
        self._tell(f"{outcome}, trusted at {trusted:.0%} of the commands")
        return trials[best].last(harm=harms[best]) if trusted >= MIN_TRUSTED else before

    def _foresee(self, correction: Correction, mirror: Mirror, number: int) -> Correction:
        """The correction with a foresight, learned in both worlds and damped as it helps most in both, if it does."""
        std = self.cfg.correction.foresight_std
        if not std:
            return correction
        worlds = ((number, self._robots.calm), (number + 1, self._robots.rough))
        traces = [self._robots.disturbed(correction, seed, ev) for seed, ev in worlds]
        if not any(trace.command.numel() for trace in traces):
            return correction
        history = self._robots.env(2, self._robots.calm).mirror["history"]
        both_sides = [*traces, *(trace.mirrored(mirror, history) for trace in traces)]
        found = foresee(both_sides, self.cfg.correction.foresight_steps, DAMPINGS[0])
        damped = [replace(found, damping=found.damping.new_tensor(damping)) for damping in DAMPINGS]
        candidates = [correction, *(replace(correction, foresight=foresight) for foresight in damped)]
        costs = [cost.mean().item() for cost in self._costs(candidates, number + 2)[1:]]
        best = costs.index(min(costs))
        how = f"damped by {DAMPINGS[best - 1]:g}" if best else "left out"
        self._tell(f"cost {costs[0]:.3f} -> {costs[best]:.3f} with foresight {how}")
        return candidates[best]

    def _costs(self, corrections: list[Correction], number: int) -> list[Tensor]:
        """Commands (4 M, 5), and what each correction costs there (4 M,): calm robots, then rough ones.

        They are given another command half-way, at which a robot may fall that stood under each from rest
        (docs/experiments.md, 35).
        """
        worlds = ((number, self._robots.calm), (number + 1, self._robots.rough))
        rollouts = [
            [self._robots.follow(each, seed, ev=ev, num_commands=2) for seed, ev in worlds] for each in corrections
        ]
        return [torch.cat([r.command for r in rollouts[0]]), *(torch.cat([r.cost for r in both]) for both in rollouts)]

    def _probe(self, correction: Correction, number: int) -> Probe:
        """Robots with a change, with its negative and without; those that fell are left out."""
        shape = (self.cfg.correction.num_envs, correction.weights.shape[2])
        change = torch.randn(shape, generator=self._robots.generator(number))
        change = self.cfg.correction.std * change.to(correction.weights)
        more, less, plain = (self._robots.follow(correction, number, way * change) for way in (1.0, -1.0, 0.0))
        answer = 0.5 * (more.waves - less.waves)
        probe = Probe(command=plain.command, change=change, answer=answer, error=plain.waves)
        return probe.of(self._require_most(~(more.fell | less.fell | plain.fell)))

    def _require_most(self, stood: Tensor) -> Tensor:
        """The robots that stood, of whom there must be enough to learn from."""
        if stood.float().mean() < MIN_SURVIVAL:
            raise _TooFewStoodError
        return stood

    def _tell(self, outcome: str) -> None:
        Console(stderr=True).print(f"{self.stage.name}: {outcome}", highlight=False, soft_wrap=True)

    def _save(self, correction: Correction, seconds: float) -> Path:
        """Write a checkpoint that other stages start from as from any other."""
        iterations = self.stage.iterations
        state = self._learner | {
            "runner": {"next_iteration": iterations, "env_steps": self._robots.env_steps, "wall_time": seconds},
            "correction": correction.state_dict(),
        }
        return ckpt.save_checkpoint(
            self.folder / "checkpoints",
            state,
            self.provenance,
            iteration=iterations,
            env_steps=self._robots.env_steps,
            stage_end=True,
        )
