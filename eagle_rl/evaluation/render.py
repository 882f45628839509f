"""Tables as Markdown, csv, LaTeX and json."""

from __future__ import annotations

import csv
import dataclasses
import io
import json

from eagle_rl.evaluation.report import Cell, Row, Table

SYMBOLS = ("E_vx", "E_vy", "E_w", "E_h", "E_p")
UNITS = ("m/s", "m/s", "rad/s", "m", "rad")
_BRACKETS = "In brackets: the paper's number."


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _text(cell: Cell, plus_minus: str = " ± ") -> str:
    """``mean ± std [paper]``."""
    spread = f"{plus_minus}{_number(cell.std)}" if cell.std is not None else ""
    paper = f" [{_number(cell.paper)}]" if cell.paper is not None else ""
    return _number(cell.mean) + spread + paper


def _best(table: Table) -> set[tuple[str, str, int]]:
    """Robot, method and column of the lowest error of each robot among the methods that were judged."""
    best = set()
    for robot in dict.fromkeys(row.robot for row in table.rows):
        for d in range(len(SYMBOLS)):
            scores = {
                row.method: mean
                for row in table.rows
                if row.robot == robot and row.seeds and (mean := row.cells[d].mean) is not None
            }
            if len(scores) > 1:
                best.add((robot, min(scores, key=lambda method: scores[method]), d))
    return best


def method_name(row: Row) -> str:
    """The method, and whether it met the robot for the first time."""
    return f"{row.method} (unseen)" if row.unseen else row.method


def _percent(cell: Cell | None) -> str:
    return "-" if cell is None or cell.mean is None else f"{100 * cell.mean:.1f} %"


def _millions(row: Row) -> str:
    return "-" if row.env_steps is None else f"{row.env_steps / 1e6:.1f}"


def _notes(table: Table, bold: bool) -> str:
    """What stands in the table and does not explain itself."""
    cells = [cell for row in table.rows for cell in row.cells]
    notes = {
        "Bold: the lowest of a robot's judged methods.": bold,
        _BRACKETS: _has_paper(table),
        "± is the standard deviation over training seeds.": any(cell.std is not None for cell in cells),
        "M steps of the run: millions of environment steps of the run that made a seed's policy; what a root from "
        "elsewhere had cost before is not counted.": any(row.env_steps is not None for row in table.rows),
        "Unseen: the method was not trained on this robot.": any(row.unseen for row in table.rows),
    }
    return " ".join(note for note, applies in notes.items() if applies)


def _has_paper(table: Table) -> bool:
    return any(cell.paper is not None for row in table.rows for cell in row.cells)


def to_markdown(table: Table) -> str:
    """GitHub Markdown, one table for all robots; the paper's numbers in brackets."""
    head = [
        "robot",
        "method",
        *(f"{s} [{u}]" for s, u in zip(SYMBOLS, UNITS, strict=True)),
        "survival",
        "seeds",
        "M steps of the run",
    ]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    best = _best(table)
    for row in table.rows:
        errors = [
            f"**{_text(cell)}**" if (row.robot, row.method, d) in best else _text(cell)
            for d, cell in enumerate(row.cells)
        ]
        cells = [
            row.robot,
            method_name(row),
            *errors,
            _percent(row.survival),
            str(len(row.seeds) or "-"),
            _millions(row),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    hashes = [f"- {method}: {', '.join(h[:12] for h in hashes)}" for method, hashes in table.checkpoints.items()]
    return "\n".join(
        [*lines, "", table.caption, _notes(table, bool(best)), "", "Checkpoints (sha256):", "", *hashes, ""]
    )


def to_csv(table: Table) -> str:
    """One line per robot and method; full precision."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    kinds = ("", "_std", "_paper")
    writer.writerow(
        [
            "robot",
            "method",
            "unseen",
            *(s + kind for s in SYMBOLS for kind in kinds),
            "survival",
            "num_seeds",
            "env_steps",
        ]
    )
    for row in table.rows:
        values = [value for cell in row.cells for value in (cell.mean, cell.std, cell.paper)]
        survival = row.survival.mean if row.survival else None
        writer.writerow([row.robot, row.method, row.unseen, *values, survival, len(row.seeds), row.env_steps])
    return text.getvalue()


def _latex(text: str) -> str:
    """Escape what LaTeX reads as a command."""
    return text.replace("%", r"\%").replace("_", r"\_").replace("|c\\_d|", "$|c_d|$")


def to_latex(table: Table) -> str:
    """A booktabs table."""
    symbols = ("$E_{v_x}$", "$E_{v_y}$", r"$E_{\omega}$", "$E_h$", "$E_p$")
    lines = [
        r"\begin{table}",
        rf"\caption{{{_latex(table.caption)}{f' {_BRACKETS}' * _has_paper(table)}}}",
        r"\begin{tabular}{ll" + "r" * (len(symbols) + 1) + "}",
        r"\toprule",
        " & ".join(["robot", "method", *symbols, "survival"]) + r" \\",
    ]
    robot = None
    for row in table.rows:
        if row.robot != robot:
            lines.append(r"\midrule")
        cells = [_latex(_text(cell, "@").replace("@", r" $\pm$ ")) for cell in row.cells]
        name = _latex(row.robot) if row.robot != robot else ""
        lines.append(" & ".join([name, _latex(method_name(row)), *cells, _latex(_percent(row.survival))]) + r" \\")
        robot = row.robot
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def to_json(table: Table) -> str:
    """Everything, for programs."""
    return json.dumps(dataclasses.asdict(table), indent=1)


FORMATS = {"md": to_markdown, "csv": to_csv, "tex": to_latex, "json": to_json}
"""Writer of each file suffix."""
