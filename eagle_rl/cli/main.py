"""``eagle VERB ...``: find the verb, run it, turn what goes wrong into one message and an exit code.

Verbs are imported only when called, so that ``--help`` and configuration errors need not wait for torch.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from eagle_rl._version import __version__
from eagle_rl.errors import EagleError, EagleWarning, did_you_mean

VERBS: dict[str, str] = {
    "train": "run an experiment into a run directory, or resume one",
    "play": "show a checkpoint: browser, window or video",
    "evaluate": "tracking errors and survival of checkpoints: the paper's table",
    "plot": "figures from runs: curves, latents, rounds",
    "export": "a checkpoint as ONNX with its input/output contract",
    "sim2sim": "an exported policy in plain MuJoCo, without torch",
    "status": "progress of a run and its stages",
    "robots": "list, show or check robots",
    "bench": "how fast this machine collects and learns",
    "doctor": "check this installation",
}
"""Each verb ``v`` is ``eagle_rl.cli.v:main``."""

INTERRUPTED = 130

_FIRST = """first steps:
  eagle doctor               is everything here?
  eagle play                 watch the published policy; eagle play --last your newest run
  eagle train quickstart     train your own in minutes; eagle status RUN tells how far it is

eagle VERB --help tells more."""


def usage() -> str:
    """The text of ``eagle --help``."""
    verbs = "\n".join(f"  {verb:<10} {summary}" for verb, summary in VERBS.items())
    title = f"eagle {__version__}: one whole-body controller for many humanoids."
    return f"{title}\n\nusage: eagle VERB ...\n\n{verbs}\n\n{_FIRST}"


def guarded(action: Callable[[], int]) -> int:
    """Run ``action``; report a user's error in words, and return the exit code."""
    try:
        with _warnings_in_words():
            try:
                return action()
            finally:
                sys.stdout.flush()  # here, where a reader who has left is no fault
    except EagleError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt as error:
        print(str(error) or "interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader, such as head, has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "eagle_rl", "envs"):  # a fault of ours
            raise
        print(
            f"error: {package} is not installed in {sys.executable}. Run make setup, then source .venv/bin/activate; "
            "eagle doctor lists what is missing.",
            file=sys.stderr,
        )
        return EagleError.exit_code
    except OSError as error:
        if error.strerror is None:
            raise
        where = "" if error.filename is None else f"{error.filename}: "
        print(f"error: {where}{error.strerror}.", file=sys.stderr)
        return EagleError.exit_code


@contextlib.contextmanager
def _warnings_in_words() -> Iterator[None]:
    """Print our warnings as one line, each time they are given; leave others to Python."""
    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=EagleWarning)
        show = warnings.showwarning

        def show_ours(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, EagleWarning):
                print(f"warning: {message}", file=sys.stderr)
            else:
                show(message, category, *where, **more)

        warnings.showwarning = show_ours
        yield


def run_verb(verb: str, argv: Sequence[str]) -> int:
    """Run one verb with its arguments and return the exit code; the entry point of ``train.py`` and ``play.py``."""
    return guarded(lambda: importlib.import_module(f"eagle_rl.cli.{verb}").main(argv))


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of the ``eagle`` command."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    verb = arguments[0] if arguments else "--help"
    return run_verb(verb, arguments[1:]) if verb in VERBS else guarded(lambda: _answer(verb))


def _answer(word: str) -> int:
    """Help or the version, asked for instead of a verb."""
    if word not in ("-h", "--help", "help", "-V", "--version"):
        raise EagleError(f"no verb {word!r}.{did_you_mean(word, VERBS)} Known: {', '.join(VERBS)}.")
    print(__version__ if word in ("-V", "--version") else usage())
    return 0


if __name__ == "__main__":
    sys.exit(main())
