"""What of this machine a process may use; nothing here needs an installed package."""

from __future__ import annotations

import os
import shutil
import sys

from eagle_rl.errors import CompileError


def usable_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def own_cores(jobs: int = 1) -> int:
    """Cores for each of ``jobs`` processes side by side, or of those torchrun started on this machine; at least one."""
    return max(1, usable_cores() // (jobs * int(os.getenv("LOCAL_WORLD_SIZE", "1"))))


def find_compiler() -> str:
    """The C++ compiler that TorchInductor will take.

    Raises:
        CompileError: it is not there.
    """
    name = os.getenv("CXX", "clang++" if sys.platform == "darwin" else "g++")
    if shutil.which(name) is None:
        raise CompileError(f"There is no C++ compiler {name!r}. On Debian: apt install g++; or name another in CXX.")
    return name
