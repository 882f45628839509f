"""The wheel and the source archive carry the data, and an installed package works from an empty folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from eagle_rl.config.compose import known_names

ROOT = Path(__file__).resolve().parents[1]
FILES = ("setup.py", "pyproject.toml", "MANIFEST.in", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE",
         "Makefile", "constraints.txt", "train.py", "play.py")  # fmt: skip


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    """Folder with a wheel and a source archive, built from a copy of the tree."""
    pytest.importorskip("setuptools", minversion="70.1", reason="building needs setuptools")
    tree = tmp_path_factory.mktemp("tree")
    for name in FILES:
        shutil.copy(ROOT / name, tree)
    for name in ("eagle_rl", "envs", "cfg", "assets", "checkpoints"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "setup.py", "--quiet", "sdist", "bdist_wheel"]
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return tree / "dist"


def test_the_wheel_works_from_an_empty_folder(archives, tmp_path):
    (wheel,) = archives.glob("*.whl")
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    empty = tmp_path / "empty"
    empty.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(site)}
    main = ["-m", "eagle_rl.cli.main"]
    for words in (
        [*main, "train", "smoke", "--show"],
        [*main, "robots", "check", *known_names("robots")],
        ["-c", "from eagle_rl.cli import play, policy; policy.load_policy(play.PUBLISHED)"],
    ):
        command = [sys.executable, *words]
        done = subprocess.run(command, cwd=empty, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


def test_the_wheel_carries_every_data_file_but_no_learner_and_no_test(archives):
    (wheel,) = archives.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    data = {f"eagle_rl/data/{path.relative_to(ROOT).as_posix()}"
            for folder in ("cfg", "assets") for path in (ROOT / folder).rglob("*") if path.is_file()}  # fmt: skip
    data |= {f"eagle_rl/data/checkpoints/{path.name}" for path in (ROOT / "checkpoints").glob("generalist.*")}
    assert data <= names
    assert not [name for name in names if name.startswith(("tests/", "cfg/", "assets/")) or name.endswith(".pt")]


def test_the_source_archive_can_be_built_from(archives):
    (archive,) = archives.glob("*.tar.gz")
    with tarfile.open(archive) as tar:
        names = {name.partition("/")[2] for name in tar.getnames()}
    assert {*FILES, "cfg/experiment/smoke.yaml", "assets/urdf/h1.urdf", "eagle_rl/cli/main.py"} <= names


def test_constraints_name_every_direct_dependency():
    text = (ROOT / "setup.py").read_text(encoding="utf-8")
    needed = text.partition("install_requires=[")[2].partition("]")[0]
    names = [line.strip().strip('",').partition(">")[0] for line in needed.splitlines() if line.strip()]
    tested = {line.partition("==")[0].lower() for line in (ROOT / "constraints.txt").read_text().splitlines()}
    assert len(names) > 10
    assert {name.lower() for name in names} <= tested
