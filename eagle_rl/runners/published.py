"""Policies as safetensors: weights to publish, in a format that cannot hold code."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from eagle_rl.errors import CheckpointError
from eagle_rl.runners.files import write_atomically

SUFFIX = ".safetensors"


def write_published(
    path: Path, weights: Mapping[str, Tensor], architecture: Mapping[str, Any], manifest: Mapping[str, Any]
) -> None:
    """Write the weights of a policy with what is needed to rebuild it and to know where it comes from."""
    tensors = {key: x.detach().cpu().contiguous() for key, x in weights.items()}
    about = json.dumps({"architecture": architecture, "manifest": manifest})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, save(tensors, {"about": about, "sha256": _digest(about, tensors)}))


def read_published(path: Path) -> tuple[dict[str, Tensor], dict[str, Any], dict[str, Any]]:
    """Weights, architecture and manifest of a published policy."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata()
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (no iterator)
        sound = _digest(metadata["about"], tensors) == metadata["sha256"]
        about = json.loads(metadata["about"])
        weights, architecture, manifest = tensors, about["architecture"], about["manifest"]
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(f"{path}: not a published policy of ours: {error}.") from error
    if not sound:
        raise CheckpointError(f"{path}: damaged: its content does not match its own digest. Fetch it again.")
    return weights, architecture, manifest


def _digest(about: str, tensors: Mapping[str, Tensor]) -> str:
    """Sha256 of everything that matters in the file."""
    digest = hashlib.sha256(about.encode())
    for key in sorted(tensors):
        digest.update(f"{key} {tuple(tensors[key].shape)} {tensors[key].dtype}".encode())
        digest.update(tensors[key].numpy().tobytes())
    return digest.hexdigest()
