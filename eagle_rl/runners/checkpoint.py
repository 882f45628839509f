"""Checkpoints that can be trusted: a data file and a manifest that proves it whole.

``model_<iteration>.pt`` holds tensors and plain values only; ``model_<iteration>.json`` names its size and sha256, what
it belongs to, and its own digest. Both are written to a temporary file, flushed to disk and moved into place, the
manifest last, so that whatever has a manifest was written completely.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from eagle_rl.errors import CheckpointError, EagleWarning
from eagle_rl.models import EagleActor
from eagle_rl.models.correction import Correction
from eagle_rl.runners import published
from eagle_rl.runners.files import write_atomically
from eagle_rl.runners.plan import RESIDUAL
from eagle_rl.runners.provenance import Provenance

FORMAT_VERSION = 1
MAX_MANIFEST_BYTES = 4 << 20
_CORRECTION = "correction."
"""What the names of a correction's tensors begin with in a published file."""

Manifest = dict[str, Any]


@dataclass(frozen=True)
class Checkpoint:
    """A verified checkpoint."""

    path: Path
    """Its data file."""
    manifest: Manifest
    state: dict[str, Any] = field(repr=False)


def save_checkpoint(
    folder: Path,
    state: Mapping[str, Any],
    provenance: Provenance,
    *,
    iteration: int,
    env_steps: int,
    score: float | None = None,
    stage_end: bool = False,
) -> Path:
    """Write ``model_<iteration>`` and return the path of its data file.

    Args:
        folder: the run's ``checkpoints`` folder, made if it does not exist.
        state: nested dicts and lists of tensors, numbers and strings.
        provenance: what the checkpoint belongs to.
        iteration: completed iterations of the stage.
        env_steps: environment steps spent in the stage.
        score: mean reward, by which the best checkpoint is found.
        stage_end: whether this is the last checkpoint of its stage, which is never pruned.
    """
    buffer = io.BytesIO()
    torch.save(dict(state), buffer)
    data = buffer.getvalue()
    path = folder / f"model_{iteration}.pt"
    manifest = provenance.as_manifest() | {
        "format": FORMAT_VERSION,
        "file": path.name,
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "iteration": iteration,
        "env_steps": env_steps,
        "score": score,
        "stage_end": stage_end,
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data)
    write_atomically(path.with_suffix(".json"), _encode_manifest(manifest))
    return path


def mark_stage_end(path: Path) -> Path:
    """Mark a checkpoint that exists as the last of its stage; only its manifest is replaced."""
    manifest = verify_checkpoint(path) | {"stage_end": True}
    write_atomically(path.with_suffix(".json"), _encode_manifest(manifest))
    return path


def load_checkpoint(path: Path, slot_table_hash: str | None = None, device: str | torch.device = "cpu") -> Checkpoint:
    """Read a checkpoint whole and return it only if everything about it is sound.

    Args:
        path: its data file or its manifest.
        slot_table_hash: refuse checkpoints of another slot table, if given.
        device: where tensors are put; the random states among them stay usable only on the CPU.
    """
    path = Path(path).with_suffix(".pt")
    manifest = read_manifest(path)
    data = _read_verified(path, manifest)
    _require_slot_table(path, manifest, slot_table_hash)
    return Checkpoint(path, manifest, _unpickle(path, data, device))


def load_actor(
    path: Path, device: str | torch.device = "cpu", slot_table_hash: str | None = None
) -> tuple[EagleActor, Manifest]:
    """The policy of a checkpoint or of a published file, in evaluation mode, and its manifest with the ``config``.

    Args:
        path: a checkpoint, or a file :func:`publish_policy` wrote.
        device: where the policy computes.
        slot_table_hash: refuse policies of another slot table, if given.
    """
    path = Path(path)
    if path.suffix == published.SUFFIX:
        tensors, architecture, manifest = published.read_published(path)
        weights = {name: x for name, x in tensors.items() if not name.startswith(_CORRECTION)}
        _require_slot_table(path, manifest, slot_table_hash)
    else:
        checkpoint = load_checkpoint(path, slot_table_hash)
        manifest, architecture = checkpoint.manifest, checkpoint.state.get("architecture", {})
        weights = checkpoint.state.get("algorithm", {}).get("actor_state_dict", {})
    try:
        with torch.device("meta"):  # claims no memory, whatever sizes the file names
            actor = EagleActor.from_architecture(architecture)
        actor.load_state_dict(weights, assign=True)
    except (KeyError, TypeError, AttributeError, RuntimeError, ValueError) as error:
        raise CheckpointError(f"{path}: does not hold a policy of this version: {error}") from error
    return actor.to(device).eval(), manifest


def require_whole(path: Path, manifest: Manifest) -> None:
    """Refuse a residual specialist, whose actions mean nothing without those of the base they are added to.

    Raises:
        CheckpointError: it is one.
    """
    if str(manifest.get("stage")).startswith(RESIDUAL):
        raise CheckpointError(
            f"{path}: a residual specialist of COMPASS, which acts only on top of its base, expected a whole policy. "
            "How it follows stands in its stage's evaluation.json; compass/distill has learned what it does."
        )


def load_correction(path: Path, device: str | torch.device = "cpu") -> Correction | None:
    """What the policy of a checkpoint or of a published file is corrected by, if anything."""
    path = Path(path)
    if path.suffix == published.SUFFIX:
        tensors = published.read_published(path)[0]
        saved = {name.removeprefix(_CORRECTION): x for name, x in tensors.items() if name.startswith(_CORRECTION)}
    else:
        saved = load_checkpoint(path).state.get("correction", {})
    try:
        return Correction.from_state({name: x.to(device) for name, x in saved.items()}) if saved else None
    except TypeError as error:
        raise CheckpointError(f"{path}: holds a correction of another version: {error}. Correct it again.") from error


def publish_policy(path: Path, target: Path, env_steps: int | None = None) -> Path:
    """Write the policy of a checkpoint as safetensors, for readers its manifest beside it; return the former's path.

    A corrected specialist takes its correction along.

    Args:
        path: the checkpoint.
        target: where to; its whole name is kept, dots and all.
        env_steps: what the policy has cost, if that is more than its own stage.

    Raises:
        CheckpointError: ``path`` is damaged, or published already.
    """
    if path.suffix == published.SUFFIX:
        raise CheckpointError(
            f"{path}: published already, expected a checkpoint. Copy it and what lies beside it under its name, or "
            "publish the checkpoint it was made from."
        )
    checkpoint = load_checkpoint(path)
    target = target.with_name(target.name.removesuffix(published.SUFFIX) + published.SUFFIX)
    correction = {f"{_CORRECTION}{name}": x for name, x in checkpoint.state.get("correction", {}).items()}
    weights = checkpoint.state["algorithm"]["actor_state_dict"] | correction
    manifest = checkpoint.manifest | ({} if env_steps is None else {"env_steps": env_steps})
    published.write_published(target, weights, checkpoint.state["architecture"], manifest)
    data = target.read_bytes()
    about = {"file": target.name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    write_atomically(target.with_suffix(".json"), _encode_manifest({"published": about, "policy": manifest}))
    return target


def read_manifest(path: Path) -> Manifest:
    """The manifest of a data file, checked against its own digest and format."""
    source = Path(path).with_suffix(".json")
    try:
        with source.open("rb") as file:
            text = file.read(MAX_MANIFEST_BYTES + 1)
    except FileNotFoundError as error:
        raise CheckpointError(f"{source}: no such manifest. A data file without one was never completed.") from error
    except OSError as error:
        raise CheckpointError(f"{source}: cannot be read: {error.strerror}.") from error
    try:
        manifest = json.loads(text)
        digest = manifest.pop("digest")
        sound = _encode_manifest(manifest) == text and isinstance(digest, str)
    except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
        sound = False
    if not sound:
        raise CheckpointError(f"{source}: damaged: it does not match its own digest. Use another checkpoint.")
    if manifest.get("format") != FORMAT_VERSION:
        raise CheckpointError(
            f"{source}: format {manifest.get('format')}, expected {FORMAT_VERSION}. Use the version that wrote it."
        )
    if manifest["file"] != source.with_suffix(".pt").name:
        raise CheckpointError(f"{source}: names {manifest['file']!r} as its data, expected its neighbour of that name.")
    return manifest


def verify_checkpoint(path: Path) -> Manifest:
    """Check manifest, size and sha256 without opening the data; return the manifest."""
    manifest = read_manifest(path)
    _read_verified(Path(path).with_suffix(".pt"), manifest)
    return manifest


def misfits(own: Any, saved: Any, where: str) -> Iterator[str]:
    """What in a saved state has other entries, types or shapes than the live one it is to replace.

    None on either side means "nothing yet" and fits; so do lists of values, which may be of any length.
    """
    if own is None or saved is None:
        return
    if isinstance(own, dict) and isinstance(saved, dict):
        for key in own | saved:
            if key in own and key in saved:
                yield from misfits(own[key], saved[key], f"{where}.{key}")
            else:
                yield f"{where}.{key}: {'unknown here' if key in saved else 'missing'}"
    elif isinstance(own, torch.Tensor) and isinstance(saved, torch.Tensor):
        if (own.shape, own.dtype) != (saved.shape, saved.dtype):
            yield f"{where}: {tuple(saved.shape)} {saved.dtype}, expected {tuple(own.shape)} {own.dtype}"
    elif isinstance(own, (list, tuple)) and isinstance(saved, (list, tuple)):
        if any(isinstance(item, torch.Tensor) for item in own):
            yield from misfits(dict(enumerate(own)), dict(enumerate(saved)), where)
    elif type(own) is not type(saved):
        yield f"{where}: {type(saved).__name__}, expected {type(own).__name__}"


def latest_checkpoint(folder: Path) -> Path | None:
    """The verified checkpoint of the highest iteration; damaged ones are passed over with a warning."""
    newest_first = sorted(_data_files(folder), key=iteration_of, reverse=True)
    return next((path for path in newest_first if _is_sound(path)), None)


def best_checkpoint(folder: Path) -> Path | None:
    """The checkpoint with the highest score."""
    scored = [(m["score"], path) for path, m in _manifests(folder).items() if m["score"] is not None]
    return max(scored, default=(None, None), key=lambda item: (item[0], iteration_of(item[1])))[1]


def prune_checkpoints(folder: Path, keep: int) -> None:
    """Delete all but the last ``keep``, the best, and the ends of stages; and what interrupted saves left behind."""
    manifests = _manifests(folder)
    last = sorted(manifests, key=iteration_of)[-keep:]
    for path in set(manifests) - {*last, best_checkpoint(folder)}:
        if not manifests[path]["stage_end"]:
            path.with_suffix(".json").unlink(missing_ok=True)
            path.unlink(missing_ok=True)
    never_completed = [path for path in _data_files(folder) if not path.with_suffix(".json").exists()]
    for leftover in [*never_completed, *folder.glob(".model_*.tmp")]:
        leftover.unlink(missing_ok=True)


def iteration_of(path: Path) -> int:
    """Number in the name of a checkpoint."""
    match = re.fullmatch(r"model_(\d+)", path.stem)
    if match is None:
        raise CheckpointError(f"{path}: not a checkpoint; the name should be model_<iteration>.pt.")
    return int(match[1])


def _require_slot_table(path: Path, manifest: Manifest, expected: str | None) -> None:
    """Refuse a policy whose slots mean other joints."""
    got = manifest["slot_table_hash"]
    if expected is not None and got != expected:
        raise CheckpointError(
            f"{path}: made for another slot table ({got[:12]}), expected {expected[:12]}: "
            "its actions would move the wrong joints. Use the version that wrote it."
        )


def _encode_manifest(manifest: Manifest) -> bytes:
    """The one spelling of a manifest, with its digest."""
    digest = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
    return (json.dumps(manifest | {"digest": digest}, sort_keys=True, indent=1) + "\n").encode()


def _data_files(folder: Path) -> list[Path]:
    return [path for path in Path(folder).glob("model_*.pt") if re.fullmatch(r"model_\d+", path.stem)]


def _is_sound(path: Path) -> bool:
    """Whether a checkpoint passes :func:`verify_checkpoint`; warns if not."""
    try:
        verify_checkpoint(path)
    except CheckpointError as error:
        warnings.warn(f"Passing over a checkpoint. {error}", EagleWarning, stacklevel=3)
        return False
    return True


def _manifests(folder: Path) -> dict[Path, Manifest]:
    """Readable manifests of a folder, by data file."""
    found = {}
    for path in _data_files(folder):
        with contextlib.suppress(CheckpointError):
            found[path] = read_manifest(path)
    return found


def _read_verified(path: Path, manifest: Manifest) -> bytes:
    """The data of a checkpoint, refused unless it is what the manifest promises."""
    try:
        size = path.stat().st_size
        if size != manifest["bytes"]:
            raise CheckpointError(f"{path}: damaged: {size} bytes, its manifest promises {manifest['bytes']}.")
        data = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror}.") from error
    if hashlib.sha256(data).hexdigest() != manifest["sha256"]:
        raise CheckpointError(f"{path}: damaged: its sha256 is not the one in its manifest. Use another checkpoint.")
    return data


def _unpickle(path: Path, data: bytes, device: str | torch.device) -> dict[str, Any]:
    """Tensors and plain values; anything that would run code, or unfold in memory, is refused."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise CheckpointError(f"{path}: refused: holds compressed entries, which no checkpoint of ours does.")
        state = torch.load(io.BytesIO(data), map_location=device, weights_only=True)
    except CheckpointError:
        raise
    except Exception as error:
        reason = str(error).splitlines()[0]
        raise CheckpointError(f"{path}: refused: holds more than tensors and plain values ({reason}).") from error
    if not isinstance(state, dict):
        raise CheckpointError(f"{path}: refused: holds a {type(state).__name__}, expected a dict.")
    return state
