"""The ``eagle`` command: exit codes, and no traceback for what a user did."""

from __future__ import annotations

import sys
import types

import pytest

from eagle_rl import errors
from eagle_rl.cli import main as cli


@pytest.fixture
def verb(monkeypatch):
    """A verb whose behaviour the test sets."""
    module = types.ModuleType("eagle_rl.cli.stub")
    monkeypatch.setitem(sys.modules, "eagle_rl.cli.stub", module)
    monkeypatch.setitem(cli.VERBS, "stub", "a verb of this test")
    return module


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (errors.ConfigError(["a: wrong", "b: wrong"]), 2),
        (errors.RobotError("wrong"), 3),
        (errors.HealthError("wrong"), 4),
        (errors.CheckpointError("wrong"), 5),
        (KeyboardInterrupt(), 130),
    ],
)
def test_each_kind_of_stop_has_its_exit_code_and_no_traceback(verb, error, code, capsys):
    def fail(argv):
        raise error

    verb.main = fail
    assert cli.main(["stub"]) == code
    message = capsys.readouterr().err
    assert "Traceback" not in message
    assert all(line in message for line in str(error).splitlines())


def test_a_fault_of_ours_is_not_hidden(verb):
    def fail(argv):
        raise ZeroDivisionError

    verb.main = fail
    with pytest.raises(ZeroDivisionError):
        cli.main(["stub"])


def test_a_verb_gets_the_words_after_it(verb):
    verb.main = lambda argv: len(argv)
    assert cli.main(["stub", "a", "--b"]) == 2


def test_an_unknown_verb_is_refused_with_the_nearest(capsys):
    assert cli.main(["trian"]) == 2
    assert "no verb 'trian'. Did you mean train?" in capsys.readouterr().err


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"]])
def test_help_names_every_verb(words, capsys):
    assert cli.main(words) == 0
    out = capsys.readouterr().out
    assert all(verb in out for verb in cli.VERBS)
