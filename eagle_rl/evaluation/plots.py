"""Figures of the experiment section, as matplotlib figures that are readable in print."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Figure  # re-exported, so that only this module names matplotlib
from numpy.typing import NDArray
from PIL import Image

from eagle_rl.config.schema import EvaluationCfg, Range
from eagle_rl.evaluation.curves import Curve, RoundScores
from eagle_rl.evaluation.estimator import ChannelScore, EstimatorReport
from eagle_rl.evaluation.latents import Embeddings
from eagle_rl.evaluation.metrics import RobotMetrics
from eagle_rl.evaluation.report import pooled_score
from eagle_rl.evaluation.response import Response
from eagle_rl.evaluation.robustness import Sweep

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Distinguishable without colour vision (Okabe and Ito); with markers, also in grey."""
MARKERS = "osDv^P*"
ERRORS = ("$E_{v_x}$ [m/s]", "$E_{v_y}$ [m/s]", r"$E_\omega$ [rad/s]", "$E_h$ [m]", "$E_p$ [rad]")
TRACES = ("$v_x$ [m/s]", "$v_y$ [m/s]", r"$\omega$ [rad/s]", "$h$ [m]", "$p$ [rad]")


def _panels(rows: int, columns: int, width: float = 3.0, height: float = 2.4) -> tuple[Figure, NDArray[np.object_]]:
    """A grid of axes with light grids and no boxes."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.flat:
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
    return figure, axes


def _legend(figure: Figure, ax: Axes, columns: int) -> None:
    """One legend under all panels."""
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as PNG, of 256 colours to keep it small, and PDF; the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    png, pdf = (folder / f"{name}.{suffix}" for suffix in ("png", "pdf"))
    figure.savefig(pdf, dpi=150)  # of pictures in it; lines have none
    figure.savefig(png, dpi=200)
    with Image.open(png) as picture:
        picture.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(png, optimize=True)
    return [png, pdf]


def learning_curves(panels: Mapping[str, Sequence[Curve]]) -> Figure:
    """One panel per quantity, one line per robot, over environment steps."""
    columns = min(3, len(panels))
    figure, axes = _panels(-(-len(panels) // columns), columns)
    colours = _palette(curve.robot for curves in panels.values() for curve in curves)
    for ax, (title, curves) in zip(axes.flat, panels.items(), strict=False):
        for curve in sorted(curves, key=lambda curve: curve.robot):
            ax.plot(np.array(curve.env_steps) / 1e6, curve.values, color=colours[curve.robot], label=curve.robot)
        ax.set_title(title, fontsize=10)
        ax.set_xlabel("environment steps [M]", fontsize=9)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    _legend(figure, axes.flat[0], len(colours))
    return figure


def _palette(names: Iterable[str]) -> dict[str, str]:
    """The same colour for the same fleet's robot in every figure."""
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(sorted(set(names)))}


def error_rounds(scores: Sequence[RoundScores]) -> Figure:
    """Errors over rounds (paper, Fig. tracking-error curves): open triangles specialists, filled ones generalists."""
    figure, axes = _panels(1, len(ERRORS), width=2.6)
    colours = _palette(score.robot for score in scores)
    for d, ax in enumerate(axes.flat):
        for robot, colour in colours.items():
            own = sorted((s for s in scores if s.robot == robot), key=lambda s: s.position)
            ax.plot([s.position for s in own], [s.errors[d] for s in own], color=colour, linewidth=1.2, label=robot)
            for score in own:
                face = "white" if score.specialist else colour
                ax.plot(score.position, score.errors[d], "^", color=colour, markerfacecolor=face)
        ax.set_title(ERRORS[d], fontsize=10)
        ax.set_xlabel("round", fontsize=9)
        ax.set_ylim(bottom=0)
        ax.xaxis.get_major_locator().set_params(integer=True)
    for label, face in (("specialist", "white"), ("generalist", "black")):
        axes[0, 0].plot([], [], "^", color="black", markerfacecolor=face, label=label)
    _legend(figure, axes[0, 0], len(colours) + 2)
    return figure


def latent_maps(maps: Mapping[str, tuple[Embeddings, NDArray[np.float32], float, float]]) -> Figure:
    """t-SNE maps side by side; each with its silhouette score and linear-probe accuracy in the title."""
    figure, axes = _panels(1, len(maps), width=3.6, height=3.4)
    for ax, (title, (embeddings, points, silhouette, accuracy)) in zip(axes.flat, maps.items(), strict=True):
        colours = _palette(embeddings.robots)
        for i, robot in enumerate(embeddings.robots):
            own = points[embeddings.robot == i]
            ax.scatter(own[:, 0], own[:, 1], s=8, color=colours[robot], marker=MARKERS[i % 7], label=robot)
        ax.set_title(f"{title}\nsilhouette {silhouette:.2f}, linear probe {accuracy:.1%}", fontsize=10)
        ax.set_xticks([])
        ax.set_yticks([])
        ax.spines[:].set_visible(False)
    _legend(figure, axes.flat[0], 3 * len(maps))
    return figure


def responses(all_responses: Sequence[Response]) -> Figure:
    """Commanded (dashed) and measured traces: one row per robot, one column per command; a cross marks a fall."""
    figure, axes = _panels(len(all_responses), len(TRACES), width=2.1, height=1.5)
    axes[0, 0].plot([], [], "x", color=COLOURS[1], label="fall")
    for row, response in zip(axes, all_responses, strict=True):
        for d, ax in enumerate(row):
            commanded, measured = response.commanded[:, d], response.measured[:, d]
            low, high = commanded.min(), commanded.max()
            margin = 0.4 * (high - low)
            ax.set_ylim(low - margin, high + margin)
            ax.plot(response.time, commanded, "--", color="0.3", linewidth=1, label="commanded")
            ax.plot(response.time, measured, color=COLOURS[0], linewidth=1, label="measured")
            fallen = np.isnan(measured)
            if fallen.any():
                last = max(0, int(fallen.argmax()) - 1)
                level = np.clip(np.nan_to_num(measured[last]), low - 0.9 * margin, high + 0.9 * margin)
                ax.plot(response.time[last], level, "x", color=COLOURS[1])
        row[0].set_ylabel(response.robot, fontsize=10)
    for d, title in enumerate(TRACES):
        axes[0, d].set_title(title, fontsize=10)
        axes[-1, d].set_xlabel("time [s]", fontsize=9)
    _legend(figure, axes[0, 0], 3)
    return figure


def robustness(
    panels: Iterable[tuple[Sweep, Mapping[float, Mapping[str, RobotMetrics]]]],
    ev: EvaluationCfg,
    ranges: Sequence[Range],
) -> Figure:
    """Survival (top) and mean error relative to standing still (bottom) over each disturbance.

    Args:
        panels: each disturbance, with the scores of every robot by its strength.
        ev: the protocol.
        ranges: what the commands were drawn from.
    """
    sweeps = list(panels)
    figure, axes = _panels(2, len(sweeps))
    for column, (sweep, scores) in zip(axes.T, sweeps, strict=True):
        colours = _palette(next(iter(scores.values())))
        for i, (robot, colour) in enumerate(colours.items()):
            style = {"color": colour, "marker": MARKERS[i % 7], "markersize": 4, "label": robot}
            own = [score[robot] for score in scores.values()]
            column[0].plot(list(scores), [100 * metrics.survival for metrics in own], **style)
            column[1].plot(list(scores), [pooled_score({robot: metrics}, ev, ranges) for metrics in own], **style)
        column[0].set_ylabel("survival [%]", fontsize=9)
        column[0].set_ylim(-3, 103)
        column[1].set_ylabel("error / standing still [-]", fontsize=9)
        column[1].set_ylim(bottom=0)
        column[1].set_xlabel(sweep.label, fontsize=9)
    _legend(figure, axes[0, 0], len(COLOURS))
    return figure


def estimator_bars(report: EstimatorReport, floor: float = -0.5) -> Figure:
    """Explained variance of each channel: bars over the fleet and within robots, a marker for each robot.

    What is below ``floor``, an estimate that errs more than the target varies, is drawn there.
    """
    figure, axes = _panels(1, 1, width=10.0, height=4.2)
    ax, place = axes[0, 0], np.arange(len(report.channels))
    for shift, label, scores, colour in (
        (-0.2, "fleet", report.fleet, "0.78"),
        (0.2, "within robots", report.within, "0.5"),
    ):
        ax.bar(place + shift, _explained(scores, floor), 0.4, color=colour, label=label)
    colours = _palette(report.robots)
    for i, (robot, scores) in enumerate(report.robots.items()):
        style = {"color": colours[robot], "marker": MARKERS[i % 7], "markersize": 4, "linestyle": "none"}
        shift = 0.2 + 0.07 * (i - 0.5 * (len(colours) - 1))
        ax.plot(place + shift, _explained(scores, floor), label=robot, clip_on=False, **style)
    ax.set_xticks(place, [channel.name for channel in report.channels], rotation=60, ha="right", fontsize=8)
    ax.set_xlim(-0.6, len(place) - 0.4)
    ax.set_ylim(floor, 1.02)
    ax.axhline(0.0, color="black", linewidth=0.8)
    ax.set_ylabel("explained variance [-]", fontsize=9)
    ax.grid(axis="x", visible=False)
    _legend(figure, ax, len(colours) + 2)
    return figure


def _explained(scores: Sequence[ChannelScore], floor: float) -> NDArray[np.float64]:
    """Explained variances, not below ``floor``; NaN where there is none."""
    return np.array([np.nan if score.explained is None else max(floor, score.explained) for score in scores])


def film_strips(strips: Mapping[str, Sequence[tuple[NDArray[np.uint8], str]]]) -> Figure:
    """Pictures over time, one row per robot, each with a line of text above it."""
    columns = max(len(strip) for strip in strips.values())
    height, width, _ = next(iter(strips.values()))[0][0].shape
    figure, axes = _panels(len(strips), columns, width=1.7, height=1.7 * height / width + 0.35)
    for row, (robot, strip) in zip(axes, strips.items(), strict=True):
        for ax, (picture, text) in zip(row, strip, strict=True):
            ax.imshow(picture)
            ax.set_title(text, fontsize=7.5)
            ax.set(xticks=[], yticks=[])
            ax.grid(visible=False)
            ax.spines[:].set_visible(False)
        row[0].set_ylabel(robot, fontsize=10)
    return figure
