"""Tables of known results."""

from __future__ import annotations

import csv
import dataclasses
import io
import json

import pytest

from eagle_rl.config.schema import CommandRangeCfg, CommandsCfg, EvaluationCfg, TaskCfg
from eagle_rl.errors import ConfigError
from eagle_rl.evaluation.evaluate import EvaluationResult, evaluate
from eagle_rl.evaluation.metrics import SUBSETS, RobotMetrics, TrackingErrors
from eagle_rl.evaluation.protocol import finishing_ranges
from eagle_rl.evaluation.reference import PAPER
from eagle_rl.evaluation.render import FORMATS, to_csv, to_json, to_latex, to_markdown
from eagle_rl.evaluation.report import pooled_score, tracking_table
from tests.evaluation.fake import idle, make_scripted_env, perfect

EV = EvaluationCfg(num_envs_per_robot=16, num_steps=2)
RANGES = finishing_ranges(CommandsCfg())
NARROW = ((0.0, 0.3), *RANGES[1:])


def result(
    errors: tuple[float | None, ...], seed: int = 1, ev: EvaluationCfg = EV, robots=("h1",), unseen=()
) -> EvaluationResult:
    subset = TrackingErrors(share=1.0, errors=errors, charged=tuple(e and 2 * e for e in errors))
    metrics = RobotMetrics(num_envs=16, survival=0.5, upright=0.75, subsets=dict.fromkeys(SUBSETS, subset))
    return EvaluationResult(
        checkpoint=f"{seed:064x}",
        protocol=ev,
        robots=dict.fromkeys(robots, metrics),
        seed=seed,
        env_steps=2_000_000 * seed,
        unseen=unseen,
    )


def test_seeds_become_mean_and_standard_deviation():
    runs = [result((0.1, 0.2, 0.3, 0.4, 0.5), seed=1), result((0.3, 0.2, 0.3, 0.4, 0.5), seed=2)]
    row = tracking_table({"EAGLE": runs}, falls="errors").rows[-1]
    assert row.cells[0].mean == pytest.approx(0.2)
    assert row.cells[0].std == pytest.approx(0.1 * 2**0.5)
    assert row.cells[1].std == pytest.approx(0.0)
    assert row.seeds == (1, 2)
    assert row.env_steps == 3_000_000


def test_steps_are_labelled_as_those_of_the_run_alone():
    text = to_markdown(tracking_table({"EAGLE": [result((0.1,) * 5)]}))
    assert text.splitlines()[0].endswith("| M steps of the run |")
    assert "a root from elsewhere had cost before is not counted" in text


def test_the_papers_number_stands_beside_ours_only_for_its_methods_and_robots():
    table = tracking_table({"EAGLE": [result((0.1,) * 5, robots=("h1", "mine"))], "mine": [result((0.1,) * 5)]})
    papers = {(row.robot, row.method): row.cells[0].paper for row in table.rows}
    assert papers[("h1", "EAGLE")] == PAPER["EAGLE"]["h1"][0]
    assert papers[("mine", "EAGLE")] is None
    assert papers[("h1", "mine")] is None


def test_a_robot_a_method_was_not_trained_on_is_labelled_and_the_papers_number_left_out():
    table = tracking_table({"PPO": [result((0.1,) * 5, robots=("h1", "g1"), unseen=("h1",))]})
    labels = {row.robot: (row.unseen, row.cells[0].paper) for row in table.rows if row.method == "PPO"}
    assert labels == {"h1": (True, None), "g1": (False, PAPER["PPO"]["g1"][0])}
    for text in (to_markdown(table), to_latex(table)):
        assert text.count("PPO (unseen)") == 1
    assert [row["unseen"] for row in csv.DictReader(io.StringIO(to_csv(table))) if row["method"] == "PPO"] == [
        "True",
        "False",
    ]


@pytest.mark.parametrize(("protocol", "zero", "told"), [("standing", 0, "exactly zero"), ("upright", 3, "height and")])
def test_standing_and_upright_have_floors_of_their_own_and_no_numbers_of_the_paper(protocol, zero, told):
    ev = dataclasses.replace(EV, protocol=protocol)
    table = tracking_table({"PPO": [result((0.1,) * 5, ev=ev)]})
    assert table.rows[0].cells[zero].mean == 0.0
    assert table.rows[-1].cells[0].paper is None
    assert told in table.caption


def test_charged_errors_are_shown_unless_asked_otherwise():
    runs = {"PPO": [result((0.1,) * 5)]}
    assert tracking_table(runs).rows[-1].cells[0].mean == pytest.approx(0.2)
    assert tracking_table(runs, falls="errors").rows[-1].cells[0].mean == pytest.approx(0.1)


def test_every_robot_has_the_floor_rows():
    table = tracking_table({"PPO": [result((0.1,) * 5, robots=("h1", "g1"))]})
    floors = [row for row in table.rows if row.method == "stand still"]
    assert [row.robot for row in floors] == ["h1", "g1"]
    assert [cell.mean for cell in floors[0].cells] == pytest.approx([0.50, 0.20, 0.50, 0.15, 0.2125])


def test_floors_of_a_table_are_of_the_ranges_its_results_were_drawn_from():
    narrow = dataclasses.replace(result((0.1,) * 5), ranges=NARROW)
    assert tracking_table({"PPO": [narrow]}).rows[0].cells[0].mean == pytest.approx(0.15)
    with pytest.raises(ConfigError, match="of the same commands, got 2 sets"):
        tracking_table({"PPO": [narrow], "EAGLE": [result((0.1,) * 5)]})


def test_results_of_different_protocols_are_refused():
    other = EvaluationCfg(num_envs_per_robot=17)
    with pytest.raises(ConfigError, match="one protocol, got 2, which differ in num_envs_per_robot, num_steps:"):
        tracking_table({"PPO": [result((0.1,) * 5)], "EAGLE": [result((0.1,) * 5, ev=other)]})


def test_all_formats_carry_the_same_numbers():
    table = tracking_table({"PPO": [result((0.1234, 0.2, 0.3, 0.4, 0.5))]}, falls="errors")
    assert set(FORMATS) == {"md", "csv", "tex", "json"}
    assert "0.123 [0.108]" in to_markdown(table)
    assert "0.123 [0.108]" in to_latex(table)
    assert float(list(csv.DictReader(io.StringIO(to_csv(table))))[-1]["E_vx"]) == 0.1234
    assert json.loads(to_json(table))["rows"][-1]["cells"][0]["mean"] == 0.1234


def test_the_lowest_error_of_each_robot_is_bold_and_floors_never_are():
    table = tracking_table({"A": [result((0.1, 0.2, 0.3, 0.4, 0.5))], "B": [result((0.2, 0.1, 0.9, 0.9, 0.9))]})
    lines = {line.split(" | ")[1]: line for line in to_markdown(table).splitlines() if line.startswith("| h1")}
    assert lines["A"].count("**") == 2 * 4
    assert "**0.200**" in lines["B"]
    assert "**" not in lines["best constant"]


def test_only_notes_that_apply_stand_under_a_table():
    plain = tracking_table({"mine": [result((0.1,) * 5)]})
    runs = {
        "A": [result((0.1,) * 5, seed=1, unseen=("h1",)), result((0.3,) * 5, seed=2)],
        "EAGLE": [result((0.2,) * 5)],
    }
    full = tracking_table(runs)
    for note in ("Bold", "In brackets", "±", "Unseen"):
        assert note not in to_markdown(plain), note
        assert note in to_markdown(full), note
    assert "millions of environment steps" in to_markdown(plain)
    assert "In brackets" not in to_latex(plain)
    assert "In brackets" in to_latex(full)


@pytest.mark.parametrize(
    ("protocol", "told"),
    [("single", "four commands zero, the other drawn from the"), ("joint", "all five commands drawn from the")],
)
def test_the_caption_says_what_is_drawn_from_the_finishing_ranges(protocol, told):
    ev = dataclasses.replace(EV, protocol=protocol)
    assert f"{told} finishing ranges" in tracking_table({"PPO": [result((0.1,) * 5, ev=ev)]}).caption


def test_a_subset_without_steps_shows_a_dash():
    table = tracking_table({"PPO": [result((None,) * 5)]}, falls="errors")
    assert "| - [0.108] |" in to_markdown(table)


@pytest.mark.parametrize(
    ("protocol", "ranges", "idle_score"),
    [
        ("joint", RANGES, 1.0),
        ("joint", NARROW, 1.0),
        ("standing", RANGES, 1.0),
        ("upright", RANGES, 3 / 5),
    ],
)
def test_the_pooled_score_is_zero_for_a_perfect_and_one_for_an_idle_robot(protocol, ranges, idle_score):
    """Of a command that is always zero an idle robot makes no error."""
    ev = EvaluationCfg(num_envs_per_robot=4000, num_steps=2, resampling_time_s=0.02, protocol=protocol)
    commands = CommandsCfg(lin_vel_x=CommandRangeCfg(initial=ranges[0], finishing=ranges[0]))
    task = TaskCfg(commands=commands)
    scores = [pooled_score(evaluate(p, make_scripted_env, ["h1", "g1"], task, ev), ev, ranges) for p in (perfect, idle)]
    assert scores == pytest.approx([0.0, idle_score], abs=0.02)
