"""A program that is measured, in a process and mostly in an interpreter of its own."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from eagle_rl.errors import EagleError
from eagle_rl.paths import data_root

from .turns import About, Rates, Setting

PATIENCE = 900.0
"""How long a program may take to get ready, or for a turn [s]."""


@dataclass(frozen=True)
class Program:
    """Who is measured, and how to start it."""

    name: str
    module: str
    """In this package."""
    python: str
    """Interpreter of the environment it is installed in."""
    variant: str = ""


class Contender:
    """A started program, which waits asleep until it is its turn."""

    def __init__(self, program: Program, setting: Setting, folder: Path) -> None:
        """Start it in a folder of its own below ``folder``, and wait until it is ready.

        Raises:
            EagleError: it failed.
        """
        own = folder / f"{program.name} {setting.num_envs}"
        own.mkdir()
        self.name, self._log = program.name, own / "log"
        words = json.dumps(asdict(replace(setting, variant=program.variant)))
        read, write = os.pipe()
        self._answers = os.fdopen(read)
        command = [program.python, "-m", f"benchmarks.peers.{program.module}", words, str(write)]
        environment = {**os.environ, "PYTHONPATH": str(data_root())}
        try:
            with self._log.open("w") as log:
                self._process = subprocess.Popen(
                    command,
                    cwd=own,
                    env=environment,
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                    text=True,
                    pass_fds=[write],
                )
        except OSError as error:
            self._answers.close()
            raise EagleError(f"{program.name} cannot be started: {error}") from error
        finally:
            os.close(write)
        self.about = About(**self._answer())

    def turn(self) -> Rates:
        """Let it measure once.

        Raises:
            EagleError: it failed.
        """
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write("\n")
            self._process.stdin.flush()
        return self._answer()

    def stop(self) -> None:
        """End it, which is what the end of its input tells it to do."""
        self._process.communicate()
        self._answers.close()

    def _answer(self) -> Any:
        answered, _, _ = select.select([self._answers], [], [], PATIENCE)
        if not answered:
            self._process.kill()
        line = self._answers.readline() if answered else ""
        if not line:
            self.stop()
            happened = "failed" if answered else f"did not answer for {PATIENCE:g} s"
            raise EagleError(f"{self.name} {happened}:\n{self._log.read_text()[-2000:]}")
        return json.loads(line)


def take_turns(
    programs: list[Program], setting: Setting, rounds: int, folder: Path, say: Callable[[str], None]
) -> tuple[dict[str, About], dict[str, list[Rates]]]:
    """Start all programs, then let one after another measure, so many times; what fails is left out from then on.

    Args:
        programs: who takes part.
        setting: what to measure; each program's variant is its own.
        rounds: how many turns each has.
        folder: where their files go.
        say: told what goes on.

    Returns:
        What each is, and what it measured.
    """
    contenders: list[Contender] = []
    try:
        for program in programs:
            say(f"starting {program.name} with {setting.num_envs} environments")
            try:
                contenders.append(Contender(program, setting, folder))
            except EagleError as error:
                say(f"left out: {error}")
        abouts = {contender.name: contender.about for contender in contenders}
        rates: dict[str, list[Rates]] = {name: [] for name in abouts}
        for number in range(1, rounds + 1):
            for contender in list(contenders):
                try:
                    measured = contender.turn()
                except EagleError as error:
                    say(f"left out from now on: {error}")
                    contenders.remove(contender)
                    continue
                rates[contender.name].append(measured)
                shown = ", ".join(f"{kind} {rate:.0f}" for kind, rate in measured.items())
                say(f"round {number} of {rounds}: {contender.name}: {shown} env-steps/s")
    finally:
        for contender in contenders:
            contender.stop()
    return abouts, rates
