"""What the estimator scored, as Markdown and csv."""

from __future__ import annotations

import csv
import io

from eagle_rl.evaluation.estimator import MIN_SPREAD, ChannelScore, EstimatorReport


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def to_markdown(report: EstimatorReport, caption: str) -> str:
    """One line per channel: explained variance of the fleet, within robots and of each robot, then the errors."""
    head = ["channel", "fleet", "within", *report.robots, "RMSE", "fleet's prior", "robot's prior", "unit"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for i, channel in enumerate(report.channels):
        fleet, within = report.fleet[i], report.within[i]
        shares = [_share(score.explained) for score in (fleet, within, *(robot[i] for robot in report.robots.values()))]
        errors = [f"{error:.3g}" for error in (fleet.rmse, fleet.prior, within.prior)]
        lines.append("| " + " | ".join([channel.name, *shares, *errors, channel.unit]) + " |")
    return "\n".join([*lines, "", caption, ""])


def describe(envs: int, steps: int, seed: int, checkpoint: str) -> str:
    """What the numbers mean, and what has to be known to repeat them."""
    return (
        "Explained variance, 1 - Var(error) / Var(target): over the whole fleet, where telling the robots apart "
        "explains most; within robots, variances about each robot's own mean; and of each robot; "
        f"- where a target varies by less than {MIN_SPREAD:g} of the channel's unit in the loss. RMSE is over the "
        "fleet, bias included. Priors are standard deviations: the fleet's is the error of somebody who knows nothing, "
        "a robot's that of somebody who knows which robot it is and nothing more. "
        f"{envs} environments a robot, {steps} steps, five samples a second from 1 s on until the first fall; full "
        f"randomization, pushes and sensor noise, all commands drawn every 4 s; seed {seed}. "
        f"Checkpoint (sha256): {checkpoint[:12]}."
    )


def to_csv(report: EstimatorReport) -> str:
    """One line per group of robots and channel; full precision."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["robots", "channel", "explained_variance", "rmse", "prior", "unit"])
    groups: dict[str, tuple[ChannelScore, ...]] = {"fleet": report.fleet, "within": report.within, **report.robots}
    for group, scores in groups.items():
        for channel, score in zip(report.channels, scores, strict=True):
            writer.writerow([group, channel.name, score.explained, score.rmse, score.prior, channel.unit])
    return text.getvalue()
