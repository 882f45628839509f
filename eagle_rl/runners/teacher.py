"""A specialist from a file, taken into a run as a robot's teacher."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from eagle_rl.config.load import experiment_from_plain
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.errors import CheckpointError, did_you_mean
from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.runners.checkpoint import Manifest, load_actor, load_correction, require_whole, save_checkpoint
from eagle_rl.runners.locate import find_checkpoint
from eagle_rl.runners.plan import TEACHERS, Stage
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.root import require_columns, tell_changed_meaning


def open_teacher(cfg: ExperimentCfg, stage: Stage, provenance: Provenance) -> tuple[Path, EagleActor, Manifest]:
    """The file of a stage's ``source``, a checkpoint, a published file or a folder with one; its policy and manifest.

    Raises:
        CheckpointError: it is the policy of another robot, or cannot teach the experiment's network.
    """
    named, robot = stage.source or "", provenance.name_of(stage.robots[0])
    if not Path(named).exists():
        words = f"{', '.join(TEACHERS)} or a file or folder that is there"
        raise CheckpointError(f"plan.teachers: got {named!r}, expected {words}.{did_you_mean(named, TEACHERS)}")
    source = find_checkpoint(Path(named))
    actor, manifest = load_actor(source, slot_table_hash=provenance.slot_table_hash)
    require_whole(source, manifest)
    if {robot, stage.robots[0]}.isdisjoint(manifest["robots"]):  # where earlier versions had the path
        of = ", ".join(manifest["robots"])
        raise CheckpointError(
            f"plan.teachers: {source}: a policy of {of}, expected one of {robot}; teachers are in the order of robots."
        )
    got, expected = actor.architecture["networks"]["embedding_dim"], cfg.algo.network.embedding_dim
    if got != expected:
        raise CheckpointError(
            f"plan.teachers: {source}: has an embedding of {got}, expected algo.network.embedding_dim {expected}."
        )
    return source, actor, manifest


def take_teacher(
    cfg: ExperimentCfg,
    stage: Stage,
    checkpoints: Path,
    provenance: Provenance,
    sizes: Callable[[], Mapping[str, int]],
    first: bool = True,
) -> Path:
    """Put a specialist into a run, so that the run is complete without its file; its checkpoint there.

    Args:
        cfg: the experiment as the stage sees it.
        stage: whose ``source`` is taken.
        checkpoints: folder of the stage.
        provenance: of the stage.
        sizes: columns of the experiment's observation groups.
        first: whether this is the first of several data-parallel processes; the others leave it to it.

    Raises:
        CheckpointError: as :func:`open_teacher`, or it sees other observations than the experiment shows.
    """
    path = checkpoints / "model_0.pt"
    if first:
        source, actor, manifest = open_teacher(cfg, stage, provenance)
        was, columns = experiment_from_plain(manifest["config"], str(source)).task, sizes()
        shown = {group: columns[group] for group in ACTOR_INPUTS}
        require_columns("plan.teachers", source, actor.architecture["observations"], shown, was.observations)
        tell_changed_meaning("plan.teachers", source, was, cfg.task)
        correction = load_correction(source)
        state = {
            "architecture": actor.architecture,
            "algorithm": {"actor_state_dict": actor.state_dict()},
            "runner": {"next_iteration": 0, "env_steps": 0, "wall_time": 0.0},
        } | ({} if correction is None else {"correction": correction.state_dict()})
        provenance = replace(provenance, parents=(manifest["sha256"],))
        save_checkpoint(checkpoints, state, provenance, iteration=0, env_steps=0, stage_end=True)
    return path
