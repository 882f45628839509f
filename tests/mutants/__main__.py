"""``make mutants``: make each mistake of the catalogue in a copy of the tree and see whether its tests notice.

    python -m tests.mutants [WORD ...]     all, or those whose file or text holds one of the words

Exit code 0 if all were killed, 1 if one survived or could not be tried.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.mutants.catalogue import MUTANTS, Mutant

ROOT = Path(__file__).resolve().parents[2]
PARTS = ("eagle_rl", "envs", "cfg", "assets", "tests", "pyproject.toml", "setup.py")
PASSED, FAILED = 0, 1
"""Exit codes of pytest; any other means that no test was run."""


def copy_tree(target: Path) -> None:
    """Copy what tests need."""
    for part in PARTS:
        source = ROOT / part
        if source.is_dir():
            shutil.copytree(source, target / part, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, target)


def run_tests(tree: Path, files: Sequence[str]) -> int:
    """Exit code of pytest in a tree, stopping at the first failure."""
    command = [sys.executable, "-B", "-m", "pytest", "-x", "--no-header", *(f"tests/{file}" for file in files)]
    environment = os.environ | {"PYTHONPATH": str(tree)}
    return subprocess.run(command, cwd=tree, env=environment, capture_output=True, check=False).returncode


def fate(tree: Path, mutant: Mutant) -> str:
    """``killed``, ``SURVIVED`` or ``BROKEN``; the tree is left as it was."""
    path = tree / mutant.file
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(mutant.old, mutant.new, 1), encoding="utf-8")
    code = run_tests(tree, mutant.tests.split())
    path.write_text(text, encoding="utf-8")
    return {FAILED: "killed", PASSED: "SURVIVED"}.get(code, "BROKEN")


def main(words: Sequence[str]) -> int:
    """Try the mutants that the words choose."""
    chosen = [m for m in MUTANTS if not words or any(w in f"{m.file} {m.old}" for w in words)]
    files = sorted({file for mutant in chosen for file in mutant.tests.split()})
    with tempfile.TemporaryDirectory(prefix="eagle-mutants-") as folder:
        tree = Path(folder)
        copy_tree(tree)
        print(f"{len(chosen)} mutants against {len(files)} files of tests", flush=True)
        if run_tests(tree, files) != PASSED:
            print("the tests fail without any mutant: run make test first")
            return 1
        fates = []
        for mutant in chosen:
            start = time.monotonic()
            fates.append(fate(tree, mutant))
            where = f"{mutant.file}: {mutant.old}  ->  {mutant.new}"
            print(f"{fates[-1]:<8} {time.monotonic() - start:5.1f} s  {where}", flush=True)
    print(f"{fates.count('killed')} of {len(fates)} killed")
    return 0 if fates.count("killed") == len(fates) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
