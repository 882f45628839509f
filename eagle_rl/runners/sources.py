"""What a run takes from files, its root and its teachers, looked at before anything is written or trained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from eagle_rl.config.load import experiment_from_plain
from eagle_rl.config.schema import ExperimentCfg
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.runners.plan import Stage
from eagle_rl.runners.provenance import Provenance
from eagle_rl.runners.root import open_root, require_columns
from eagle_rl.runners.teacher import open_teacher


def check_sources(
    cfg: ExperimentCfg, stages: Sequence[Stage], provenance: Provenance, shown: Mapping[str, int] | None = None
) -> None:
    """Refuse a root or a teacher that is not there or does not fit.

    Args:
        cfg: the experiment.
        stages: its plan.
        provenance: what the run depends on.
        shown: columns of the experiment's observation groups, if known.

    Raises:
        CheckpointError: as :func:`open_root` and :func:`open_teacher`, or a teacher sees other observations.
    """
    if cfg.plan.root is not None:
        open_root(cfg, shown)
    for stage in stages:
        if stage.source is not None:
            source, actor, manifest = open_teacher(cfg, stage, provenance)
            was = experiment_from_plain(manifest["config"], str(source)).task.observations
            read = {group: shown[group] for group in ACTOR_INPUTS} if shown else {}
            require_columns("plan.teachers", source, actor.architecture["observations"], read, was)
