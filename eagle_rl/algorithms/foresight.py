"""Learns by least squares which errors a robot is about to make, and how a change of its action alters them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from eagle_rl.algorithms.correction import Mirror
from eagle_rl.models.basis import monomials, products, waves
from eagle_rl.models.foresight import ANSWER_HARMONICS, Foresight

RIDGE = 1e-4
"""Of the regression, in multiples of the number of samples."""
STEPS_AT_ONCE = 8
"""Whose features are made together, to bound memory."""


@dataclass(frozen=True)
class Trace:
    """T steps of M robots whose actions were disturbed at random."""

    history: Tensor
    """Before each step, shape (T, M, H)."""
    phase: Tensor
    """Then, shape (T, M) [cycles]."""
    command: Tensor
    """As shares of its ranges, shape (M, 5)."""
    change: Tensor
    """Of the actions, in the correction's units, shape (T, M, S)."""
    error: Tensor
    """After each step, in multiples of the error units, shape (T, M, 5)."""

    def of(self, rows: Tensor) -> Trace:
        """Some of the robots."""
        history, phase, change, error = (x[:, rows] for x in (self.history, self.phase, self.change, self.error))
        return Trace(history, phase, self.command[rows], change, error)

    def mirrored(self, mirror: Mirror, history: tuple[Tensor, Tensor]) -> Trace:
        """The same, left and right exchanged, half a cycle later.

        Args:
            mirror: of the robot.
            history: permutation and signs (H,).
        """
        (perm, sign), (command_perm, command_sign) = history, mirror.command
        return Trace(
            history=self.history[..., perm] * sign,
            phase=self.phase + 0.5,
            command=self.command[:, command_perm] * command_sign,
            change=self.change[..., mirror.partner] * mirror.sign,
            error=self.error[..., command_perm] * command_sign,
        )


def foresee(traces: Iterable[Trace], horizon: int, damping: float) -> Foresight:
    """Fit the errors of the next steps to what is seen before them and to what is added to the action.

    Args:
        traces: of as many worlds as it is to hold in; noise that is in them is not answered.
        horizon: steps that are looked ahead.
        damping: of the answer.
    """
    traces = list(traces)
    seen = torch.cat([trace.history.flatten(0, 1) for trace in traces])
    std, mean = torch.std_mean(seen, dim=0)
    columns = (std > 1e-6).nonzero().flatten()
    blank = seen.new_zeros(0)
    looks = Foresight(columns, mean[columns], std[columns], blank, blank, seen.new_tensor(damping))
    normal, right, count = _normal_equations(looks, traces, horizon)
    normal.diagonal().add_(RIDGE * count)
    solution = torch.linalg.solve(normal.double(), right.double()).to(right)
    num_joints = traces[0].change.shape[2]
    answered = (2 * ANSWER_HARMONICS + 1) * num_joints
    weights, answer = (part.clone(memory_format=torch.contiguous_format) for part in solution.tensor_split([-answered]))
    answer = answer.unflatten(0, (-1, num_joints))
    return Foresight(columns, looks.mean, looks.scale, weights, answer, looks.damping)


def _normal_equations(looks: Foresight, traces: list[Trace], horizon: int) -> tuple[Tensor, Tensor, int]:
    """Sums of products of regressors (R, R), of regressors and errors ahead (R, 5 horizon), and their number."""
    normal, right, count = torch.zeros(()), torch.zeros(()), 0
    for trace in traces:
        steps = len(trace.phase) - horizon + 1
        ahead = torch.cat([trace.error[h : h + steps] for h in range(horizon)], dim=2)
        for some in torch.arange(steps).split(STEPS_AT_ONCE):
            phase = trace.phase[some]
            basis = monomials(trace.command).expand(len(some), -1, -1)
            changed = products(waves(phase, ANSWER_HARMONICS), trace.change[some])
            rows = torch.cat((looks.features(trace.history[some], phase, basis), changed), dim=2).flatten(0, 1)
            normal, right = normal + rows.T @ rows, right + rows.T @ ahead[some].flatten(0, 1)
            count += len(rows)
    return normal, right, count
