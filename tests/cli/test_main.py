"""The ``eagle`` command: exit codes, and no traceback for what a user did."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import types
import warnings
from pathlib import Path

import pytest

from eagle_rl import errors
from eagle_rl.cli import main as cli
from eagle_rl.config.compose import known_names
from eagle_rl.config.load import load_experiment
from eagle_rl.paths import data_root


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


def test_a_warning_is_one_line_each_time_it_is_given(verb, capsys):
    def warn(argv):
        for _ in range(2):
            warnings.warn("the disk is full", errors.EagleWarning, stacklevel=2)
        return 0

    verb.main = warn
    filters = list(warnings.filters)
    assert cli.main(["stub"]) == 0
    assert capsys.readouterr().err == 2 * "warning: the disk is full\n"
    assert warnings.filters == filters


def test_other_warnings_are_left_to_python(verb):
    def warn(argv):
        warnings.warn("odd", RuntimeWarning, stacklevel=2)
        return 0

    verb.main = warn
    with pytest.warns(RuntimeWarning, match="odd"):
        assert cli.main(["stub"]) == 0


@pytest.mark.parametrize("words", [(28, "No space left"), (28, "No space left", "table.md")])
def test_what_the_system_refuses_is_said_in_words(verb, words, capsys):
    def full(argv):
        raise OSError(*words)

    verb.main = full
    assert cli.main(["stub"]) == 2
    assert capsys.readouterr().err == f"error: {'table.md: ' if len(words) == 3 else ''}No space left.\n"


def test_a_fault_of_ours_is_not_hidden(verb):
    def fail(argv):
        raise ZeroDivisionError

    verb.main = fail
    with pytest.raises(ZeroDivisionError):
        cli.main(["stub"])


@pytest.mark.parametrize("package", ["eagle_rl.nowhere", "envs.nowhere"])
def test_a_module_of_ours_that_is_missing_is_not_hidden(verb, package):
    verb.main = lambda argv: importlib.import_module(package)
    with pytest.raises(ModuleNotFoundError):
        cli.main(["stub"])


BARE = "import sys\nsys.path.insert(0, {root!r})\nfrom eagle_rl.cli.main import main\nsys.exit(main({words!r}))"


def in_a_bare_python(*words):
    """What ``eagle WORDS`` does in an interpreter without any installed package."""
    root = str(Path(__file__).resolve().parents[2])
    command = [sys.executable, "-I", "-S", "-c", BARE.format(root=root, words=list(words))]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("words", ["train smoke", "play", "evaluate RUN", "status RUN", "robots list"])
def test_without_the_requirements_a_verb_ends_in_one_line(words):
    done = in_a_bare_python(*words.split())
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1, done.stderr
    assert f"is not installed in {sys.executable}. Run make setup" in done.stderr


def test_doctor_lists_what_is_missing_without_the_requirements():
    done = in_a_bare_python("doctor")
    assert (done.returncode, done.stderr) == (2, "")
    assert all(
        f"FAIL  {name:<16} missing, needs >=" in done.stdout for name in ("torch", "mujoco", "rich", "packaging")
    )
    assert "FAIL  graphics         cannot be checked without mujoco" in done.stdout
    assert "ok    folder" in done.stdout


def test_a_verb_gets_the_words_after_it(verb):
    verb.main = lambda argv: len(argv)
    assert cli.main(["stub", "a", "--b"]) == 2


def test_an_unknown_verb_is_refused_with_the_nearest(capsys):
    assert cli.main(["trian"]) == 2
    assert "no verb 'trian'. Did you mean train?" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["status", "--help"]])
def test_a_reader_who_leaves_is_no_fault(words):
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "eagle_rl.cli.main", *words]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False, cwd=data_root())
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("verb", cli.VERBS)
def test_help_of_a_verb_is_plain_text(verb, capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main([verb, "--help"])
    assert "``" not in capsys.readouterr().out


def test_help_of_train_describes_every_experiment(capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main(["train", "--help"])
    out = " ".join(capsys.readouterr().out.split())
    for name in known_names("experiment"):
        assert f"{name} {load_experiment(name).description}" in out


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"]])
def test_help_names_every_verb(words, capsys):
    assert cli.main(words) == 0
    out = capsys.readouterr().out
    assert all(verb in out for verb in cli.VERBS)
