"""``eagle doctor``: is this installation complete, and can this machine do what will be asked of it?

What a check needs beyond the standard library is imported inside it: doctor must run where everything is missing.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import NamedTuple

from eagle_rl.errors import CompileError, EagleError
from eagle_rl.machine import find_compiler, usable_cores
from eagle_rl.paths import data_root

_RENDER = """
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><light/><geom size=".1"/></worldbody></mujoco>')
mujoco.Renderer(model, 16, 16).render()
"""


class Finding(NamedTuple):
    """Result of one check."""

    name: str
    state: str
    """``ok``, ``warn`` or ``FAIL``."""
    detail: str


def check_packages() -> list[Finding]:
    """Each required package, its version, and whether it is in the range that setup.py allows."""
    try:
        return _packages(requires("eagle-rl") or [])
    except PackageNotFoundError:
        advice = f"not installed in {sys.executable}; run make setup, then source .venv/bin/activate"
        return [Finding("eagle-rl", "FAIL", advice), *_packages(_requirements_of_checkout())]


def _requirements_of_checkout() -> list[str]:
    """What setup.py asks for; nothing where there is none."""
    setup = data_root() / "setup.py"
    nodes = ast.walk(ast.parse(setup.read_text(encoding="utf-8"))) if setup.is_file() else ()
    asked = (node.value for node in nodes if isinstance(node, ast.keyword) and node.arg == "install_requires")
    return [text for value in asked for text in ast.literal_eval(value)]


def _packages(needed: Sequence[str]) -> list[Finding]:
    findings = []
    for text in needed:
        name = re.split(r"[ <>=!~;]", text, maxsplit=1)[0]
        wanted = text.removeprefix(name)
        if ";" in wanted:  # of an extra
            continue
        found = installed_version(name)
        good = found != "missing" and _allows(wanted, found)
        advice = "" if good else f", needs {wanted}; run make setup"
        findings.append(Finding(name, "ok" if good else "FAIL", found + advice))
    return findings


def _allows(wanted: str, found: str) -> bool:
    """Whether a version is in a range, as far as it can be told: without packaging, which is reported itself, it is."""
    try:
        from packaging.specifiers import SpecifierSet
    except ModuleNotFoundError:
        return True
    return SpecifierSet(wanted).contains(found, prereleases=True)


def installed_version(package: str) -> str:
    """Version of an installed package, or ``missing``."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"


def check_machine() -> list[Finding]:
    """Python, operating system and cores that this process may use."""
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    return [
        Finding("python", "ok", f"{platform.python_version()} on {platform.platform()}"),
        Finding(
            "cores",
            "ok",
            f"{usable_cores()} usable, all are used; OMP_NUM_THREADS {threads}",
        ),
    ]


def check_data() -> list[Finding]:
    """Whether every shipped robot and experiment loads."""
    from eagle_rl.config.compose import known_names
    from eagle_rl.config.load import load_experiment
    from envs.robots.load import load_robot

    findings = []
    for kind, load in (("robots", load_robot), ("experiment", load_experiment)):
        names = known_names(kind)
        faults = [fault for name in names if (fault := _fault(load, name))]
        state = "ok" if names and not faults else "FAIL"
        findings.append(Finding(kind, state, "; ".join(faults) or f"{', '.join(names) or 'none'} in {data_root()}"))
    return findings


def _fault(load: Callable[[str], object], name: str) -> str:
    try:
        load(name)
    except EagleError as error:
        return str(error)
    return ""


def check_compiler() -> list[Finding]:
    """Whether steps can be compiled; long training is a little quicker with."""
    try:
        return [Finding("compiler", "ok", find_compiler())]
    except CompileError as error:
        return [Finding("compiler", "warn", f"{error} Training goes on without, a little slower.")]


def check_graphics() -> list[Finding]:
    """Whether pictures can be rendered without a display; tried in another process, for a bad driver may kill it."""
    if importlib.util.find_spec("mujoco") is None:
        raise ModuleNotFoundError(name="mujoco")
    backend = os.environ.get("MUJOCO_GL", "egl")
    command = [sys.executable, "-c", _RENDER]
    try:
        done = subprocess.run(
            command, env={**os.environ, "MUJOCO_GL": backend}, capture_output=True, timeout=60, check=False
        )
        good = done.returncode == 0
    except subprocess.TimeoutExpired:
        good = False
    advice = "no offscreen rendering: videos need EGL; on Debian: apt install libegl1 libgl1-mesa-dri"
    return [Finding("graphics", "ok" if good else "warn", f"offscreen by {backend}" if good else advice)]


def check_folder() -> list[Finding]:
    """Whether run directories can be made here."""
    try:
        with tempfile.TemporaryDirectory(dir=Path.cwd(), prefix=".doctor-"):
            return [Finding("folder", "ok", f"{Path.cwd()} can be written")]
    except OSError as error:
        return [Finding("folder", "warn", f"{Path.cwd()}: {error.strerror}; train with --out DIR")]


def _findings(check: Callable[[], list[Finding]]) -> list[Finding]:
    try:
        return check()
    except ModuleNotFoundError as error:
        return [Finding(check.__name__.removeprefix("check_"), "FAIL", f"cannot be checked without {error.name}")]


def main(argv: Sequence[str]) -> int:
    """Run ``eagle doctor``; 2 if something is missing without which nothing works."""
    description = "Check that this installation is complete and what this machine can do."
    argparse.ArgumentParser(prog="eagle doctor", description=description).parse_args(argv)
    findings: list[Finding] = []
    for check in (check_machine, check_packages, check_data, check_compiler, check_graphics, check_folder):
        findings += _findings(check)
    for finding in findings:
        print(f"{finding.state:<4}  {finding.name:<16} {finding.detail}")
    failed = sum(finding.state == "FAIL" for finding in findings)
    print(f"\n{failed} of {len(findings)} checks failed" if failed else "\nall in order")
    return 2 if failed else 0
