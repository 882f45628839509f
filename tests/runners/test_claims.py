"""Claims on stages: one holder, and exactly one successor of a dead one."""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from eagle_rl.runners import claims
from eagle_rl.runners.claims import Claim, ClaimLostError

ELSEWHERE = {"host": "another-machine", "pid": 1}


def leave_behind(folder: Path, holder: dict[str, object], age_s: float = 0.0) -> Path:
    """A claim whose holder is not this test."""
    path = folder / "claim.0"
    path.write_text(json.dumps(holder))
    os.utime(path, (path.stat().st_atime, path.stat().st_mtime - age_s))
    return path


def dead_pid() -> int:
    pid = os.fork()
    if pid == 0:
        os._exit(0)
    os.waitpid(pid, 0)
    return pid


def test_a_held_claim_is_refused_and_a_released_one_is_free(tmp_path):
    with Claim.acquire(tmp_path) as claim:
        claim.check()
        assert Claim.acquire(tmp_path) is None
    assert Claim.acquire(tmp_path) is not None


def test_a_claim_from_another_machine_is_respected_while_it_beats(tmp_path):
    leave_behind(tmp_path, ELSEWHERE, age_s=claims.STALE_AFTER_S / 2)
    assert Claim.acquire(tmp_path) is None


def test_a_silent_claim_is_taken_over(tmp_path):
    leave_behind(tmp_path, ELSEWHERE, age_s=claims.STALE_AFTER_S * 2)
    assert Claim.acquire(tmp_path) is not None


def test_a_claim_of_a_dead_process_is_taken_over_at_once(tmp_path):
    leave_behind(tmp_path, {"host": socket.gethostname(), "pid": dead_pid()})
    assert Claim.acquire(tmp_path) is not None


def test_exactly_one_of_many_takes_over_a_dead_claim(tmp_path):
    leave_behind(tmp_path, ELSEWHERE, age_s=claims.STALE_AFTER_S * 2)
    with ThreadPoolExecutor(16) as pool:
        won = [claim for claim in pool.map(lambda _: Claim.acquire(tmp_path), range(64)) if claim is not None]
    assert len(won) == 1


def test_who_was_taken_over_notices(tmp_path):
    claim = Claim.acquire(tmp_path)
    os.utime(claim.path, (0, 0))
    assert Claim.acquire(tmp_path) is not None
    with pytest.raises(ClaimLostError):
        claim.check()


def test_the_holder_keeps_its_claim_alive(tmp_path, monkeypatch):
    monkeypatch.setattr(claims, "HEARTBEAT_S", 0.01)
    claim = Claim.acquire(tmp_path)
    os.utime(claim.path, (0, 0))
    with claim:
        while claim.path.stat().st_mtime == 0:
            pass


def test_a_folder_that_vanished_was_taken_over_by_nobody(tmp_path, monkeypatch):
    monkeypatch.setattr(claims, "HEARTBEAT_S", 0.01)
    with Claim.acquire(tmp_path / "stage") as claim:
        shutil.rmtree(tmp_path / "stage")
        time.sleep(0.05)
        claim.check()
        assert claim._thread.is_alive()


@pytest.mark.parametrize("text", ["", "[]", '{"host": 1, "pid": "x"}'])
def test_a_claim_that_says_nothing_is_respected_while_it_is_fresh(tmp_path, text):
    (tmp_path / "claim.0").write_text(text)
    assert Claim.acquire(tmp_path) is None
    assert claims.holder(tmp_path) == "?:0"
    os.utime(tmp_path / "claim.0", (0, 0))
    assert claims.holder(tmp_path) is None
    assert Claim.acquire(tmp_path) is not None


def test_nothing_is_left_behind(tmp_path):
    with Claim.acquire(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []
