"""Penalty curriculum: regularisation starts weak and grows to its full weight (HugWBC 4)."""

from __future__ import annotations

from eagle_rl.config.schema import RewardsCfg


def penalty_scale(cfg: RewardsCfg, common_step_counter: int) -> float:
    """Factor k on penalties and pushes: ``k <- k ** exponent`` at each update, hence ``initial ** exponent ** n``.

    Args:
        cfg: initial value, exponent, and control steps between updates.
        common_step_counter: control steps since training began.

    Returns:
        k in [initial, 1).
    """
    updates = common_step_counter // cfg.penalty_interval_steps
    return float(cfg.penalty_initial ** (cfg.penalty_exponent**updates))
