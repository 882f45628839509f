"""The shape of the house, read from the source: who imports whom, and what must not be found anywhere."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from eagle_rl.cli.main import VERBS
from eagle_rl.config import schema
from eagle_rl.config.compose import known_names

ROOT = Path(__file__).resolve().parents[1]
SOURCES = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
           for package in ("eagle_rl", "envs") for path in sorted((ROOT / package).rglob("*.py"))}  # fmt: skip

LAYERS = (("config", "errors", "paths", "machine", "kernels", "threads", "_version"), ("models",), ("algorithms",),
          ("runners", "evaluation", "export"), ("cli",))  # fmt: skip
RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}

OPEN_TO_ENVS = tuple(f"eagle_rl.{name}" for name in ("config", "errors", "paths", "machine", "kernels", "threads"))

OWNERS = {
    "yaml": {"eagle_rl/config/yaml_file.py"},
    "mujoco": {"envs", "eagle_rl/cli"},
    "pinocchio": {"envs"},
    "envs": {"eagle_rl/cli"},
    "matplotlib": {"eagle_rl/evaluation", "eagle_rl/cli/plot.py"},
    "pickle": set(),
}
"""Packages that only some folders or files may import."""


NAMES_AS_DATA = {
    "eagle_rl/config/schema.py",  # which robots an experiment has if it names none
    "eagle_rl/evaluation/reference.py",  # the paper's own numbers, robot by robot
    "envs/gym.py",  # the same for gymnasium
    "envs/robots/embodiment.py",  # the bodies that o_ea is standardised over
}
"""Files that list robots without treating any of them in a way of its own."""


def imports(file: str) -> set[str]:
    """Absolute names of everything a file imports, wherever in it."""
    package = file.removesuffix(".py").split("/")[:-1]
    names: set[str] = set()
    for node in ast.walk(SOURCES[file]):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = [*base, *(node.module.split(".") if node.module else [])]
            names |= {".".join([*stem, alias.name]) for alias in node.names}
    return names


def is_within(file: str, places: set[str]) -> bool:
    return any(file == place or file.startswith(place + "/") for place in places)


@pytest.mark.parametrize("file", [f for f in SOURCES if f.startswith("eagle_rl/")])
def test_learning_imports_point_down_the_layers(file):
    own = RANK.get(file.removesuffix(".py").split("/")[1], 0)
    for name in imports(file):
        if name.startswith("eagle_rl."):
            rank = RANK.get(name.split(".")[1])
            assert rank is not None, f"{file} imports {name}, which is in no layer"
            assert rank <= own, f"{file} imports {name}, a layer above it"


@pytest.mark.parametrize("file", [f for f in SOURCES if f.startswith("envs/")])
def test_simulation_knows_of_learning_only_its_lowest_layer(file):
    foreign = {n for n in imports(file) if n.startswith("eagle_rl") and not n.startswith(OPEN_TO_ENVS)}
    assert not foreign, f"{file} imports {foreign}"


@pytest.mark.parametrize("package", OWNERS)
def test_only_its_owners_import(package):
    users = {f for f in SOURCES if any(n.split(".")[0] == package for n in imports(f))}
    strangers = {f for f in users if not is_within(f, OWNERS[package] | ({"envs"} if package == "envs" else set()))}
    assert not strangers, f"{package} is imported outside of {OWNERS[package]}"


def test_no_code_knows_a_robot_by_name():
    robots = set(known_names("robots"))
    assert robots
    found = [
        f"{file}:{node.lineno}: {node.value!r}"
        for file, tree in SOURCES.items()
        if file not in NAMES_AS_DATA
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and node.value in robots
    ]
    assert not found, f"a robot is data in cfg/robots: {found}"


def schema_fields() -> list[tuple[str, str]]:
    classes = [c for c in vars(schema).values() if isinstance(c, type) and dataclasses.is_dataclass(c)]
    return [(c.__name__, f.name) for c in classes for f in dataclasses.fields(c)]


def test_every_schema_field_is_read_by_something():
    used: set[str] = set()
    for file, tree in SOURCES.items():
        if file.startswith("eagle_rl/config/"):
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute):
                used.add(node.attr)
            elif isinstance(node, ast.FunctionDef) and file == "envs/mdp/rewards.py":
                used.add(node.name)  # a weight is read by the name of its term
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                used.add(node.value)
    dead = [f"{cls}.{name}" for cls, name in schema_fields() if name not in used]
    assert not dead, f"keys that change nothing: {dead}"


def test_files_are_short_enough_to_read():
    lengths = {file: len((ROOT / file).read_text(encoding="utf-8").splitlines()) for file in SOURCES}
    long = {file: n for file, n in lengths.items() if n > 400}
    assert not long


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_a_module(verb):
    assert importlib.util.find_spec(f"eagle_rl.cli.{verb}"), f"eagle_rl/cli/{verb}.py is missing"


QUESTIONS = [["--help"], ["--version"], ["trian"], *([verb, "--help"] for verb in VERBS),
             ["train", "pppo"], ["train", "ppo", "algo.gama=1"], ["train", "ppo", "--show"]]  # fmt: skip


@pytest.mark.parametrize("words", QUESTIONS, ids=" ".join)
def test_help_and_configuration_errors_do_not_wait_for_torch(words):
    code = (
        "import sys\nfrom eagle_rl.cli.main import main\n"
        f"try: main({words!r})\nexcept SystemExit: pass\n"
        "heavy = {'torch', 'mujoco', 'rsl_rl', 'matplotlib', 'pinocchio'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
