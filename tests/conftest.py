"""What every test runs under: one thread, no network, a folder of its own, the same hypothesis examples each time."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"  # before torch: processes that tests start compute with one thread, too

import pytest
import torch
from hypothesis import Phase, settings

from eagle_rl.threads import use_threads

phases = [Phase.explicit, Phase.generate, Phase.shrink]
settings.register_profile("eagle", derandomize=True, deadline=None, database=None, print_blob=False, phases=phases)
settings.load_profile("eagle")


def plain_torch() -> None:
    """Set back what ``set_up_torch`` sets for a whole process."""
    torch.set_num_threads(1)
    use_threads(1)
    if hasattr(torch.backends.mkldnn, "matmul"):  # torch 2.9 and later
        torch.backends.mkldnn.matmul.fp32_precision = "none"


@pytest.fixture(autouse=True)
def same_arithmetic() -> Iterator[None]:
    """Start every test with the same arithmetic, whatever a test before it has set."""
    plain_torch()
    yield
    plain_torch()


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Run in an empty folder, so that no test leaves a file behind."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True, scope="session")
def no_network() -> Any:
    """Refuse connections to other machines."""
    connect = socket.socket.connect

    def local_only(self: socket.socket, address: Any) -> None:
        local = self.family not in (socket.AF_INET, socket.AF_INET6) or address[0] in ("127.0.0.1", "::1", "localhost")
        if not local:
            raise OSError(f"a test tried to connect to {address}; tests use no network")
        connect(self, address)

    patch = pytest.MonkeyPatch()
    patch.setattr(socket.socket, "connect", local_only)
    yield
    patch.undo()
