"""What of this machine a process may use."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def own_cores(jobs: int = 1) -> int:
    """Cores for each of ``jobs`` processes side by side, or of those torchrun started on this machine; at least one."""
    return max(1, usable_cores() // (jobs * int(os.getenv("LOCAL_WORLD_SIZE", "1"))))
