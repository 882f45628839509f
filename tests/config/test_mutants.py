"""Damage a valid experiment in any way: it loads, or it is refused in words; nothing else."""

from __future__ import annotations

from pathlib import Path

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eagle_rl.config.load import load_experiment, to_yaml
from eagle_rl.errors import ConfigError, RobotError

RESOLVED = to_yaml(load_experiment("eagle")).splitlines()
SHORT = Path(__file__).parents[2].joinpath("cfg/experiment/eagle.yaml").read_text(encoding="utf-8").splitlines()

HOSTILE = st.sampled_from(
    """
    -1|0|1e999|-.inf|.nan|null|true|""|[]|{}|[[]]|[1, [2]]|{a: {b: 1}}|9999999999999999999|!!binary aGk=|*a|&a 1|@|`|
    ../../etc/passwd|"\\0"|2026-01-01|0x10|1:30|? a|- a|: :|'|"|%TAG|"\\ud800"|\u2028|\t|--- |...|#
    """.strip().split("|")
)
lines = st.integers(0, 10_000)


@st.composite
def mutants(draw):
    """A valid file with one to three injuries."""
    text = list(draw(st.sampled_from([RESOLVED, SHORT])))
    for _ in range(draw(st.integers(1, 3))):
        i = draw(lines) % len(text)
        kind = draw(st.sampled_from(["drop", "repeat", "value", "key", "indent", "cut", "insert", "swap"]))
        key, colon, value = text[i].partition(":")
        if kind == "drop" and len(text) > 1:
            del text[i]
        elif kind == "repeat":
            text.insert(i, text[i])
        elif kind == "value":
            text[i] = f"{key}: {draw(HOSTILE)}"
        elif kind == "key":
            position = draw(lines) % (len(key) + 1)
            text[i] = key[:position] + draw(st.characters(codec="utf-8")) + key[position + 1 :] + colon + value
        elif kind == "indent":
            text[i] = " " * draw(st.integers(0, 8)) + text[i].lstrip()
        elif kind == "cut":
            text[i] = text[i][: draw(lines) % (len(text[i]) + 1)]
        elif kind == "insert":
            position = draw(lines) % (len(text[i]) + 1)
            text[i] = text[i][:position] + draw(st.text(max_size=3)) + text[i][position:]
        else:
            j = draw(lines) % len(text)
            text[i], text[j] = text[j], text[i]
    return "\n".join(text)


def refusal(name: str, overrides: list[str] | None = None) -> str | None:
    """The words in which an experiment is refused, or None if it loads."""
    try:
        load_experiment(name, overrides or [])
    except (ConfigError, RobotError) as error:
        return str(error)
    return None


@settings(max_examples=500, suppress_health_check=[HealthCheck.too_slow])
@given(mutants())
def test_a_damaged_experiment_loads_or_is_refused_in_words(text):
    Path("mutant.yaml").write_bytes(text.encode("utf-8", errors="surrogatepass"))
    assert refusal("mutant.yaml") != ""


@given(st.binary(max_size=200))
def test_any_bytes_load_or_are_refused_by_file_name(content):
    Path("mutant.yaml").write_bytes(content)
    assert "mutant.yaml" in (refusal("mutant.yaml") or "mutant.yaml")


@given(st.lists(st.text(max_size=20), max_size=3))
def test_any_words_on_the_command_line_are_taken_or_refused_in_words(words):
    assert refusal("ppo", words) != ""
