"""What is drawn once, when the environments are made: each one's size, masses and centres of mass (HugWBC 8)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from eagle_rl.config.schema import RandomizationCfg

from ..rng import CounterRng
from ..robots.embodiment import EMBODIMENT_LINKS, BodyChanges
from ..sim.batch import RobotBatch
from ..sim.pool import PhysicsPool
from ..state import PooledRobots


def draw_morphology(cfg: RandomizationCfg, robots: PooledRobots, rng: CounterRng) -> tuple[Tensor, Tensor]:
    """Factors on all lengths and on all masses of each environment's robot, shape (N,) each; 1 where they are off."""
    like = robots.total_mass
    if not cfg.enabled:
        return torch.ones_like(like), torch.ones_like(like)
    once = torch.zeros_like(robots.robot_id)
    length = rng.uniform_in(*cfg.morphology_length_scale, "morphology_length", once, 1)
    mass = rng.uniform_in(*cfg.morphology_mass_scale, "morphology_mass", once, 1)
    return length.squeeze(1).to(like), mass.squeeze(1).to(like)


def resized(robots: PooledRobots, length: Tensor, mass: Tensor) -> PooledRobots:
    """The constants of robots whose lengths and masses are multiplied by factors, shape (N,) each."""
    return replace(
        robots,
        nominal_height=robots.nominal_height * length,
        swing_height=robots.swing_height * length,
        total_mass=robots.total_mass * mass,
    )


def randomize_bodies(
    cfg: RandomizationCfg, pool: PhysicsPool, robots: PooledRobots, rng: CounterRng, length: Tensor, mass: Tensor
) -> BodyChanges:
    """Draw every body of every environment and put it into the physics.

    Args:
        cfg: ranges.
        pool: simulations to change.
        robots: constants of the robots as their morphology makes them.
        rng: noise of the run.
        length: factor on lengths, shape (N,).
        mass: factor on masses, shape (N,).
    """
    shape = (len(mass), len(EMBODIMENT_LINKS))
    changes = BodyChanges(length, mass.new_ones(shape), mass.new_zeros(shape), mass.new_zeros(*shape, 3))
    if not cfg.enabled:
        return changes
    for batch, rows in zip(pool.batches, pool.rows, strict=True):
        ids = torch.arange(rows.start, rows.stop, device=mass.device)
        scale, added, offset = _draw_bodies(cfg, batch, robots.total_mass[rows], rng, ids)
        scale = scale * mass[rows].unsqueeze(1)
        batch.change_bodies(*(x.to("cpu", torch.float64).numpy() for x in (length[rows], scale, added, offset)))
        bodies = [batch.model.body(batch.spec.link_roles[role]).id for role in EMBODIMENT_LINKS]
        changes.mass_scale[rows] = scale[:, bodies].to(mass.dtype)
        changes.added_mass[rows] = added[:, bodies].to(mass.dtype)
        changes.com_offset[rows] = offset[:, bodies].to(mass.dtype)
    return changes


def _draw_bodies(
    cfg: RandomizationCfg, batch: RobotBatch, total_mass: Tensor, rng: CounterRng, ids: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Factor on mass (n, nbody), added mass [kg] (n, nbody) and shift of the centre [m] (n, nbody, 3) of each body."""
    num_bodies, base = batch.model.nbody, batch.model.body(batch.spec.base_link).id
    once = torch.zeros_like(ids)
    scale = rng.uniform_in(*cfg.link_mass_scale, "link_mass", once, num_bodies, ids)
    offset = rng.uniform_in(*cfg.link_com_offset, "link_com", once, 3 * num_bodies, ids).reshape(-1, num_bodies, 3)
    payload = rng.uniform_in(*cfg.base_mass_ratio, "base_mass", once, 1, ids).squeeze(1)
    offset[:, base, :2] += rng.uniform_in(*cfg.base_com_offset, "base_com", once, 2, ids)
    added = torch.zeros_like(scale)
    added[:, base] = payload * total_mass
    return scale, added, offset
