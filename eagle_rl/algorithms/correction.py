"""How a walking policy's errors answer to a correction, and which correction makes them least.

On flat ground the errors of a policy that walks are functions of its command and of the phase of its gait: polynomials
explain most of them (docs/experiments.md, 22). So they can be taken off like the repeating errors of a
machine tool: change the policy a little one way and the other way, see what that does to the mean and to every harmonic
of every error, and solve (iterative learning control; Bristow, Tharayil and Alleyne 2006, "A survey of iterative
learning control"). A rollout answers in 105 numbers here where a search gets one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from eagle_rl.models.basis import half_a_cycle, monomials, waves
from eagle_rl.models.correction import NUM_HARMONICS, NUM_SHIFTS, Correction

ERROR_HARMONICS = 10
"""Harmonics of an error that are looked at."""
VARIATION = 0.3
"""How much the answer may differ over the commands, as a share of what it has in common."""
SHRINKAGE = 100.0
"""Ridge of the answer, in variances of a coefficient; what a held-out fifth of the rollouts asked for."""
MAX_HARM = 2.0
"""Harm, or help, a robot is counted for at most, so that one that falls does not outvote all others [error units]."""


@dataclass(frozen=True)
class Probe:
    """Rollouts of M robots with changed coefficients, and of the same ones without."""

    command: Tensor
    """Scaled, shape (M, 5)."""
    change: Tensor
    """Of the coefficients, shape (M, C)."""
    answer: Tensor
    """Half of what lies between the errors with the change and with its negative, shape (M, 5, B)."""
    error: Tensor
    """Coefficients of :func:`error_waves` without a change, in multiples of the error units, shape (M, 5, B)."""

    def of(self, rows: Tensor) -> Probe:
        """Some of the robots."""
        return Probe(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True)
class Mirror:
    """Exchanges left and right; half a cycle later the other foot does what this one did."""

    command: tuple[Tensor, Tensor]
    """Permutation and signs (5,), of errors too."""
    partner: Tensor
    """Index of the same joint on the other side, shape (S,)."""
    sign: Tensor
    """Of that joint's mirrored action, shape (S,)."""

    def both(self, probe: Probe) -> Probe:
        """A probe and its mirror image, rows of one after the other."""
        perm, sign = self.command
        turned = sign.unsqueeze(1) * half_a_cycle(ERROR_HARMONICS).to(sign)
        joints = probe.change[:, :-NUM_SHIFTS].unflatten(1, (len(self.partner), -1))
        joints = joints[:, self.partner] * self.sign.unsqueeze(1) * half_a_cycle(NUM_HARMONICS).to(sign)
        shifts = probe.change[:, -NUM_SHIFTS:] * sign[:NUM_SHIFTS]
        image = Probe(
            command=probe.command[:, perm] * sign,
            change=torch.cat((joints.flatten(1), shifts), dim=1),
            answer=probe.answer[:, perm] * turned,
            error=probe.error[:, perm] * turned,
        )
        return Probe(*(torch.cat([getattr(x, field.name) for x in (probe, image)]) for field in fields(probe)))


def error_waves(errors: Tensor, phases: Tensor) -> Tensor:
    """Mean and harmonics of errors.

    Args:
        errors: signed, shape (T, M, 5).
        phases: of the gait at the time [cycles], shape (T, M).

    Returns:
        Shape (M, 5, 2 ERROR_HARMONICS + 1), of equal weight in the mean square over time.
    """
    basis = waves(phases.T, ERROR_HARMONICS)
    found = _ridge(basis, errors.transpose(0, 1), ridge=1e-4 * len(errors)).transpose(1, 2)
    found[..., 1:] *= math.sqrt(0.5)
    return found


def improve(correction: Correction, probe: Probe, mirror: Mirror, std: float, damping: float) -> Tensor:
    """What to add to the weights of a correction.

    The answer to a change is taken to be linear in the change, and in the command. It is solved at every command that
    was tried; a polynomial of the command then goes through the solutions.

    Args:
        correction: the present one, which tells the commands' ranges.
        probe: rollouts with it.
        mirror: of the robot.
        std: of the changes tried.
        damping: coefficient at which a change costs as much as an error of one unit.

    Returns:
        The shape of ``correction.weights`` without that of the passes.
    """
    probe = mirror.both(probe)
    command = correction.normalised(probe.command)
    context = torch.nn.functional.pad(VARIATION * command, (1, 0), value=1.0)
    answer = _linear_answer(context, probe.change, probe.answer.flatten(1), SHRINKAGE * std**2)
    basis = monomials(command)
    smooth = basis @ _ridge(basis, probe.error.flatten(1))
    steps = [_solve(rows, answer, goal, damping) for rows, goal in zip(context, smooth, strict=True)]
    return _ridge(basis, torch.stack(steps))


def expected_harm(correction: Correction, command: Tensor, harm: Tensor, mirror: Mirror) -> Tensor:
    """By how much a change makes following worse, as a polynomial of the command.

    At the corners of the commands, where robots hardly stand, a step that helps elsewhere may throw them over
    (docs/experiments.md, 25).

    Args:
        correction: tells the commands' ranges.
        command: scaled, of M robots, shape (M, 5).
        harm: cost with the change less the cost without [error units], shape (M,).
        mirror: of the robot; the harm at a mirrored command is the same.

    Returns:
        Weights of the monomials, shape (56,).
    """
    perm, sign = mirror.command
    basis = monomials(correction.normalised(torch.cat((command, command[:, perm] * sign))))
    return _ridge(basis, harm.clamp(-MAX_HARM, MAX_HARM).repeat(2).unsqueeze(1)).squeeze(1)


def _linear_answer(context: Tensor, change: Tensor, answer: Tensor, ridge: float) -> Tensor:
    """Ridge regression of ``answer`` (M, A) on products of context (M, Z) and change (M, C), shape (Z, C, A).

    In its dual form, with as many unknowns as rollouts.
    """
    kernel = (change @ change.T) * (context @ context.T)
    dual = torch.linalg.solve(kernel + ridge * torch.eye(len(kernel)).to(kernel), answer)
    return torch.einsum("mc,mz,ma->zca", change, context, dual)


def _solve(context: Tensor, answer: Tensor, error: Tensor, damping: float) -> Tensor:
    """The change (C,) with the least sum of squares of what it leaves of an error (A,) and, damped, of itself."""
    effect = torch.einsum("z,zca->ca", context, answer)
    normal = effect.T @ effect + damping**2 * torch.eye(len(error)).to(error)
    return -effect @ torch.linalg.solve(normal, error)


def _ridge(basis: Tensor, values: Tensor, ridge: float = 0.1) -> Tensor:
    """Coefficients (..., F, A) with which a basis (..., M, F) comes closest to values (..., M, A)."""
    normal = basis.mT @ basis + ridge * torch.eye(basis.shape[-1]).to(basis)
    return torch.linalg.solve(normal, basis.mT @ values)
