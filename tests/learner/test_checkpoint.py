"""Checkpoints survive being killed, and nothing but a whole one is ever loaded."""

import hashlib
import json
import os
import pickle
import random
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
import torch

from eagle_rl.errors import CheckpointError, EagleWarning
from eagle_rl.runners import checkpoint as ckpt
from eagle_rl.runners.files import write_atomically
from eagle_rl.runners.provenance import Provenance, slot_table_hash
from envs.robots.slots import SLOT_NAMES
from tests.learner.helpers import make_runner

ROOT = Path(__file__).parents[2]
PROVENANCE = Provenance(config={"name": "toy"}, robots={"one": "1a"}, slot_table_hash=slot_table_hash(SLOT_NAMES))


def save(folder: Path, iteration: int, **entries) -> Path:
    state = {"weights": torch.arange(50.0), "numbers": [1, 2.5], "words": "x"}
    return ckpt.save_checkpoint(folder, state, PROVENANCE, iteration=iteration, env_steps=10 * iteration, **entries)


def forge(path: Path, data: bytes) -> None:
    """Put ``data`` in place of a checkpoint's with a manifest that fits it."""
    manifest = ckpt.read_manifest(path)
    manifest |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    path.write_bytes(data)
    path.with_suffix(".json").write_bytes(ckpt._encode_manifest(manifest))


def test_what_was_saved_is_loaded_with_its_manifest(tmp_path):
    path = save(tmp_path, 12, score=3.5)
    loaded = ckpt.load_checkpoint(path, PROVENANCE.slot_table_hash)
    assert torch.equal(loaded.state["weights"], torch.arange(50.0))
    assert loaded.state["numbers"] == [1, 2.5]
    manifest = json.loads(path.with_suffix(".json").read_text())
    assert manifest == loaded.manifest | {"digest": manifest["digest"]}
    expected = {"iteration": 12, "env_steps": 120, "score": 3.5, "stage": "train", "config": {"name": "toy"}}
    assert expected.items() <= manifest.items()
    named = """format file bytes sha256 iteration env_steps score stage_end config config_hash robots robot_hashes
        slot_table_hash stage parents drifted versions git_commit digest"""
    assert set(named.split()) == set(manifest)
    assert manifest["bytes"] == path.stat().st_size
    assert manifest["versions"]["torch"] == metadata.version("torch")


@pytest.mark.parametrize("suffix", [".pt", ".json"])
def test_any_flipped_byte_is_refused_by_name(tmp_path, suffix):
    path = save(tmp_path, 1)
    victim = path.with_suffix(suffix)
    whole = victim.read_bytes()
    rng = random.Random(0)
    for position in {0, len(whole) - 1, *(rng.randrange(len(whole)) for _ in range(150))}:
        data = bytearray(whole)
        data[position] ^= 1 << rng.randrange(8)
        victim.write_bytes(data)
        with pytest.raises(CheckpointError, match=rf"{victim.name}: damaged"):
            ckpt.load_checkpoint(path)
    victim.write_bytes(whole)
    ckpt.load_checkpoint(path)


@pytest.mark.parametrize("kept", [0, 1, 0.5])
def test_a_truncated_file_is_refused_by_name(tmp_path, kept):
    path = save(tmp_path, 1)
    for victim in (path, path.with_suffix(".json")):
        whole = victim.read_bytes()
        victim.write_bytes(whole[: int(len(whole) * kept) if kept < 1 else 1])
        with pytest.raises(CheckpointError, match=f"{victim.name}: damaged"):
            ckpt.load_checkpoint(path)
        victim.write_bytes(whole)


class Payload:
    """Runs a command when unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self):
        return (Path.touch, (self.target,))


def test_a_pickle_payload_is_refused_and_not_run(tmp_path):
    path, target = save(tmp_path, 1), tmp_path / "owned"
    evil = tmp_path / "evil.pt"
    torch.save({"weights": Payload(target)}, evil)
    for data in (evil.read_bytes(), pickle.dumps(Payload(target))):
        forge(path, data)
        with pytest.raises(CheckpointError, match=r"model_1\.pt: refused"):
            ckpt.load_checkpoint(path)
    assert not target.exists()


def test_compressed_data_is_refused_before_it_unfolds(tmp_path):
    path = save(tmp_path, 1)
    bomb = tmp_path / "bomb.pt"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\0" * 10_000_000)
    forge(path, bomb.read_bytes())
    with pytest.raises(CheckpointError, match="compressed entries"):
        ckpt.load_checkpoint(path)


@pytest.mark.parametrize("name", ["../model_1.pt", "/etc/passwd", "model_2.pt"])
def test_a_manifest_cannot_point_elsewhere(tmp_path, name):
    path = save(tmp_path, 1)
    manifest = ckpt.read_manifest(path) | {"file": name}
    path.with_suffix(".json").write_bytes(ckpt._encode_manifest(manifest))
    with pytest.raises(CheckpointError, match="expected its neighbour"):
        ckpt.load_checkpoint(path)


def test_another_format_and_another_slot_table_are_refused(tmp_path):
    path = save(tmp_path, 1)
    with pytest.raises(CheckpointError, match="another slot table"):
        ckpt.load_checkpoint(path, slot_table_hash(["left_tentacle"]))
    manifest = ckpt.read_manifest(path) | {"format": 99}
    path.with_suffix(".json").write_bytes(ckpt._encode_manifest(manifest))
    with pytest.raises(CheckpointError, match="format 99, expected 1"):
        ckpt.load_checkpoint(path)


@pytest.mark.parametrize("name", ["model_1.pt", "nothing"])
def test_a_missing_checkpoint_is_said_in_words(tmp_path, name):
    with pytest.raises(CheckpointError, match="no such manifest"):
        ckpt.load_checkpoint(tmp_path / name)
    path = save(tmp_path, 3)
    path.unlink()
    with pytest.raises(CheckpointError, match=r"model_3\.pt: cannot be read: No such file"):
        ckpt.load_checkpoint(path)


def test_the_newest_is_found_by_number_and_falls_back_to_the_previous_good_one(tmp_path):
    assert ckpt.latest_checkpoint(tmp_path) is None
    for iteration in (9, 100, 1000):
        save(tmp_path, iteration)
    assert ckpt.latest_checkpoint(tmp_path).name == "model_1000.pt"
    (tmp_path / "model_1000.pt").write_bytes(b"damaged")
    with pytest.warns(EagleWarning, match=r"Passing over a checkpoint.*model_1000"):
        assert ckpt.latest_checkpoint(tmp_path).name == "model_100.pt"
    (tmp_path / "model_100.json").unlink()
    with pytest.warns(EagleWarning, match="model_100"):
        assert ckpt.latest_checkpoint(tmp_path).name == "model_9.pt"


def test_pruning_keeps_the_last_the_best_and_the_ends_of_stages(tmp_path):
    scores = {1: 0.0, 2: 9.0, 3: 1.0, 4: None, 5: 2.0, 6: 3.0, 7: 4.0}
    for iteration, score in scores.items():
        save(tmp_path, iteration, score=score, stage_end=iteration == 3)
    (tmp_path / ".model_8.pt.77.tmp").write_bytes(b"left by a kill")
    (tmp_path / "model_9.pt").write_bytes(b"left by a disk that was full before the manifest")
    ckpt.prune_checkpoints(tmp_path, keep=2)
    assert sorted(p.name for p in tmp_path.glob("*.pt")) == [f"model_{i}.pt" for i in (2, 3, 6, 7)]
    assert sorted(p.name for p in tmp_path.glob("*.json")) == [f"model_{i}.json" for i in (2, 3, 6, 7)]
    assert not list(tmp_path.glob(".*"))
    assert ckpt.best_checkpoint(tmp_path).name == "model_2.pt"


def test_a_reader_of_the_old_file_never_sees_the_new_one(tmp_path):
    path = tmp_path / "file"
    write_atomically(path, b"old")
    with path.open("rb") as reader:
        write_atomically(path, b"new")
        assert reader.read() == b"old"
    assert path.read_bytes() == b"new"


def test_a_failed_write_leaves_the_old_file_whole(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def full_disk(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


SAVER = """
import os, random, signal, sys, time, warnings
from pathlib import Path
import torch
from eagle_rl.runners import checkpoint as ckpt
from eagle_rl.runners.files import write_atomically
from eagle_rl.runners.provenance import Provenance
torch.set_num_threads(1)
warnings.simplefilter("ignore")
folder, rng, newest = Path(sys.argv[1]), random.Random(0), 1
state = {"weights": torch.arange(50_000.0)}
ckpt.save_checkpoint(folder, state, Provenance(), iteration=1, env_steps=0)  # the first is slow: it asks for versions
start = time.monotonic()
for _ in range(5):
    ckpt.save_checkpoint(folder, state, Provenance(), iteration=1, env_steps=0)
duration = (time.monotonic() - start) / 5
for _ in range(50):
    begun, begin = os.pipe()
    child = os.fork()
    if child == 0:
        while True:
            newest += 1
            os.write(begin, b".")
            ckpt.save_checkpoint(folder, state, Provenance(), iteration=newest, env_steps=0)
            ckpt.prune_checkpoints(folder, 2)
    for _ in range(rng.randint(1, 3)):  # however slow the machine, a save is under way
        os.read(begun, 1)
    time.sleep(rng.uniform(0, 1) * duration)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    os.close(begun), os.close(begin)
    loaded = ckpt.load_checkpoint(ckpt.latest_checkpoint(folder))
    assert torch.equal(loaded.state["weights"], state["weights"])
    assert loaded.manifest["iteration"] >= newest, (loaded.path, newest)
    newest = loaded.manifest["iteration"]
print(newest)
"""


@pytest.mark.slow
def test_a_save_loop_killed_at_50_random_moments_never_loses_a_checkpoint(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", SAVER, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 5, "the children were killed before they saved anything"


def test_a_policy_is_loaded_without_an_environment(tmp_path):
    runner = make_runner(tmp_path, provenance=PROVENANCE)
    path = runner.learn(1)
    actor, manifest = ckpt.load_actor(path, slot_table_hash=PROVENANCE.slot_table_hash)
    obs = runner.env.get_observations()
    with torch.no_grad():
        assert torch.equal(actor(obs), runner.alg.actor(obs))
    assert manifest["config"] == {"name": "toy"}
    assert not actor.training


def test_a_published_policy_is_the_checkpoint_s_and_any_flipped_byte_is_refused(tmp_path):
    runner = make_runner(tmp_path, provenance=PROVENANCE)
    checkpoint = runner.learn(1)
    path = ckpt.publish_policy(checkpoint, tmp_path / "weights" / "toy")
    actor, manifest = ckpt.load_actor(path, slot_table_hash=PROVENANCE.slot_table_hash)
    obs = runner.env.get_observations()
    with torch.no_grad():
        assert torch.equal(actor(obs), runner.alg.actor(obs))
    assert manifest == ckpt.read_manifest(checkpoint)
    told = json.loads(path.with_suffix(".json").read_text())
    assert told["policy"] == manifest
    assert told["published"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    with pytest.raises(CheckpointError, match="another slot table"):
        ckpt.load_actor(path, slot_table_hash="other")
    whole, rng = path.read_bytes(), random.Random(1)
    header = len(whole) - sum(x.numel() * 4 for x in actor.state_dict().values())
    for position in [rng.randrange(header - 8) for _ in range(60)] + [
        rng.randrange(header, len(whole)) for _ in range(60)
    ]:
        data = bytearray(whole)
        data[position] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        with pytest.raises(CheckpointError, match=r"toy\.safetensors: (damaged|not a published policy)"):
            ckpt.load_actor(path)


def test_the_whole_name_of_a_published_policy_is_kept(tmp_path):
    checkpoint = make_runner(tmp_path, provenance=PROVENANCE).learn(1)
    for name in ("v1.2", "v1.3.safetensors"):
        ckpt.publish_policy(checkpoint, tmp_path / "weights" / name)
    expected = {f"v1.{minor}{suffix}" for minor in (2, 3) for suffix in (".safetensors", ".json")}
    assert {path.name for path in (tmp_path / "weights").iterdir()} == expected


def test_what_is_published_already_is_not_published_again(tmp_path):
    path = ckpt.publish_policy(make_runner(tmp_path, provenance=PROVENANCE).learn(1), tmp_path / "old")
    with pytest.raises(CheckpointError, match="published already, expected a checkpoint"):
        ckpt.publish_policy(path, tmp_path / "new")


@pytest.mark.parametrize("hidden", [[10**9], [-1, -5], "many", [[1]]])
def test_an_absurd_architecture_is_refused_without_claiming_memory(tmp_path, hidden):
    runner = make_runner(tmp_path)
    state = runner._state()
    architecture = json.loads(json.dumps(state["architecture"]))
    architecture["networks"]["hidden_dims"] = hidden
    path = ckpt.save_checkpoint(tmp_path, state | {"architecture": architecture}, PROVENANCE, iteration=1, env_steps=0)
    with pytest.raises(CheckpointError, match="does not hold a policy"):
        ckpt.load_actor(path)


def test_a_checkpoint_without_a_policy_is_refused_in_words(tmp_path):
    with pytest.raises(CheckpointError, match="does not hold a policy"):
        ckpt.load_actor(save(tmp_path, 1))
