"""The checkpoint an experiment starts from, taken into its run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.console import Console
from torch import Tensor
from torch.nn.functional import pad

from eagle_rl.config.load import experiment_from_plain
from eagle_rl.config.schema import ExperimentCfg, ObservationsCfg, TaskCfg
from eagle_rl.errors import CheckpointError
from eagle_rl.models.actor import SIDED_GROUPS
from eagle_rl.models.sides import MirrorMap, Sides
from eagle_rl.runners.checkpoint import Manifest, load_checkpoint, load_correction, require_whole, save_checkpoint
from eagle_rl.runners.files import write_atomically
from eagle_rl.runners.locate import find_checkpoint
from eagle_rl.runners.provenance import Provenance, changes
from eagle_rl.runners.published import SUFFIX

_FIRST_LAYER = "mlp.0.weight"
_SHAPING = {
    "history": ("history_length", "last_action"),
    "command": (),
    "clock": ("clock_harmonics",),
    "estimate": ("embodiment_observation", "descriptor"),
}
"""Keys of ``task.observations`` that the number of columns of a group depends on."""


class Root(NamedTuple):
    """What an experiment starts from."""

    source: Path
    manifest: Manifest
    task: TaskCfg
    """The task it was trained in."""
    state: dict[str, Any]


def open_root(cfg: ExperimentCfg, shown: Mapping[str, int] | None = None) -> Root:
    """The checkpoint ``plan.root`` names, if training can go on from it.

    Args:
        cfg: the experiment.
        shown: columns of its observation groups, if known.

    Raises:
        CheckpointError: no training can go on from it.
    """
    try:
        source = find_checkpoint(Path(cfg.plan.root or ""))
    except CheckpointError as error:
        raise CheckpointError(f"plan.root: {error}") from error
    if source.suffix == SUFFIX:
        raise _no_critic(source, "a published policy")
    checkpoint = load_checkpoint(source)
    manifest, state = checkpoint.manifest, checkpoint.state
    require_whole(source, manifest)
    if load_correction(source) is not None:
        raise CheckpointError(
            f"plan.root: {source}: a corrected specialist, which no training can go on from: its correction is no part "
            "of its network. Use the stage before the correction, or a generalist distilled from it."
        )
    if "critic_state_dict" not in state.get("algorithm", {}):
        raise _no_critic(source, "a specialist that was given to its run")
    task, seen = experiment_from_plain(manifest["config"], str(source)).task, state["architecture"]["observations"]
    clock = min(seen["clock"], clock_columns(cfg.task.observations))  # fewer are widened
    require_columns("plan.root", source, seen, {**(shown or {}), "clock": clock}, task.observations)
    return Root(source, manifest, task, state)


def require_columns(
    setting: str, source: Path, seen: Mapping[str, int], shown: Mapping[str, int], was: ObservationsCfg
) -> None:
    """Refuse a policy that reads, or estimates, other observations than an experiment shows.

    Args:
        setting: where the policy was named.
        source: its file.
        seen: columns of the groups it was built for.
        shown: columns of the experiment's groups, those that matter.
        was: observations of the experiment it was trained in.

    Raises:
        CheckpointError: it does; names the settings to add.
    """
    wrong = [group for group in shown if shown[group] != seen[group]]
    if wrong:
        faults = ", ".join(f"{seen[group]} columns of {group}, not {shown[group]}" for group in wrong)
        remedy = " ".join(f"task.observations.{key}={getattr(was, key)}" for group in wrong for key in _SHAPING[group])
        raise CheckpointError(f"{setting}: {source}: sees {faults} as this experiment shows. Add {remedy}.")


def take_root(
    cfg: ExperimentCfg,
    checkpoints: Path,
    provenance: Provenance,
    mirror: Callable[[], MirrorMap],
    first: bool = True,
) -> Path:
    """Put ``plan.root`` into a run, so that the run is complete without it; its checkpoint there.

    A root that saw fewer harmonics of the clock gets inputs for them, with weights of zero: it acts as it did. With
    ``network.symmetric`` it acts on both sides from here on, with the weights it has.

    Args:
        cfg: the experiment.
        checkpoints: folder of the run's root stage.
        provenance: of that stage, for a root that is not taken over as it is.
        mirror: of the experiment's observations and actions.
        first: whether this is the first of several data-parallel processes; the others leave reports to it.

    Raises:
        CheckpointError: as :func:`open_root`.
    """
    source, manifest, was, state = open_root(cfg)
    symmetric, was_symmetric = cfg.algo.network.symmetric, bool(state.get("architecture", {}).get("mirror"))
    if first:
        tell_changed_meaning(
            "plan.root", source, was, cfg.task, changes("algo.network.symmetric", was_symmetric, symmetric)
        )
    new = clock_columns(cfg.task.observations) - clock_columns(was.observations)
    if new > 0 or symmetric != was_symmetric:
        about = {name: manifest[name] for name in ("iteration", "env_steps", "score")}
        if first:
            state = widen_clock(state, max(new, 0))
            state["architecture"]["mirror"] = _sides(mirror()) if symmetric else None
            save_checkpoint(checkpoints, state, provenance, stage_end=True, **about)
        return checkpoints / f"model_{about['iteration']}.pt"
    checkpoints.mkdir(parents=True, exist_ok=True)
    for suffix in (".pt", ".json"):  # the manifest last: what has one is complete; whole, for all processes copy it
        path = source.with_suffix(suffix)
        write_atomically(checkpoints / path.name, path.read_bytes())
    return checkpoints / source.name


def _no_critic(source: Path, what: str) -> CheckpointError:
    """Why nothing but a policy is no root."""
    words = "has no critic to go on from; use a checkpoint of a stage that was trained."
    return CheckpointError(f"plan.root: {source}: {what} {words}")


def _sides(mirror: MirrorMap) -> dict[str, Any]:
    """What the architecture of a two-sided actor says of its mirror."""
    return Sides({group: mirror[group] for group in SIDED_GROUPS}).to_lists()


def clock_columns(cfg: ObservationsCfg) -> int:
    """Columns of the clock an actor sees: the sine of each foot, or sine and cosine of every harmonic of each."""
    return 4 * cfg.clock_harmonics or 2


def widen_clock(state: dict[str, Any], columns: int) -> dict[str, Any]:
    """A learner's state with that many more columns of clock, last in what actor and critic read, weights zero.

    The optimiser knows its parameters, the actor's and then the critic's, by number. Of new weights it expects
    gradients as large as of the old ones beside them: with second moments of zero its first steps would be three times
    as long.
    """
    learner, optimizer = state["algorithm"], state["algorithm"]["optimizer_state_dict"]
    networks = {name: learner[f"{name}_state_dict"] for name in ("actor", "critic")}
    parameters = [f"{name}.{parameter}" for name, network in networks.items() for parameter in network]

    def zeros(weights: Tensor) -> Tensor:
        return pad(weights, (0, columns))

    moments = dict(optimizer["state"])
    for name in networks:
        at = parameters.index(f"{name}.{_FIRST_LAYER}")
        if at not in moments:  # an optimiser that has made no step
            continue
        squares = moments[at]["exp_avg_sq"]
        new = squares.mean(dim=1, keepdim=True).expand(-1, columns)
        wider = {"exp_avg": zeros(moments[at]["exp_avg"]), "exp_avg_sq": torch.cat((squares, new), dim=1)}
        moments[at] = moments[at] | wider
    widened = {
        f"{name}_state_dict": network | {_FIRST_LAYER: zeros(network[_FIRST_LAYER])}
        for name, network in networks.items()
    }
    sizes = state["architecture"]["observations"]
    return state | {
        "architecture": state["architecture"] | {"observations": sizes | {"clock": sizes["clock"] + columns}},
        "algorithm": learner | widened | {"optimizer_state_dict": optimizer | {"state": moments}},
    }


def tell_changed_meaning(setting: str, source: Path, was: TaskCfg, task: TaskCfg, more: Sequence[str] = ()) -> None:
    """Say what makes a policy's observations and actions mean something else here, and what ``more`` does."""
    seen = dataclasses.replace(was.observations, clock_harmonics=task.observations.clock_harmonics)
    before, now = (
        {part: dataclasses.asdict(getattr(t, part)) for part in ("control", "observations", "gait")}
        for t in (dataclasses.replace(was, observations=seen), task)
    )
    lines = [*changes("task", before, now), *more]
    if lines:
        listed = "\n  ".join(lines)
        text = f"warning: {setting} {source} was trained with other values, it acts differently here:\n  {listed}"
        Console(stderr=True).print(text, highlight=False, markup=False, soft_wrap=True)
