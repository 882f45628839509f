"""Uneven ground: its shape, what is measured on it, and the levels."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from eagle_rl.config.schema import ObservationsCfg, TaskCfg, TerrainCfg
from eagle_rl.errors import ConfigError
from envs.ground import Plane, Surface, UnevenGround
from envs.mdp.layout import scan_points
from envs.rng import CounterRng
from envs.robots.spec import Array
from envs.sim.terrain import BORDER, PLATFORM, Terrain, build_terrain
from envs.state import PooledState
from tests.envs.test_resume import BUSY, assert_continues
from tests.envs.worlds import actions, make_env, rollout
from tests.states import quaternion, quiet_state, random_robots

KINDS = ("rough", "slopes", "steps")
SMALL = TerrainCfg(kind="rough", num_levels=3, patch_size=5.0)
DOUBLE = torch.zeros(0, dtype=torch.float64)


def small(kind: str) -> TerrainCfg:
    return replace(SMALL, kind=kind)


def built(kind: str, seed: int = 1, cfg: TerrainCfg | None = None) -> Terrain:
    terrain = build_terrain(replace(cfg or SMALL, kind=kind), seed)
    assert terrain is not None
    return terrain


def task(kind: str) -> TaskCfg:
    return replace(TaskCfg(), terrain=small(kind))


def rays_down(model: mujoco.MjModel, points: Array) -> Array:
    """World z of the floor under points of the plane, shape (n, 2), by MuJoCo's ray cast."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    floor = model.geom("floor").id
    down, normal = np.array([0.0, 0.0, -1.0]), np.zeros(3)
    heights = []
    for x, y in points:
        start = np.array([x, y, 20.0])
        distance = mujoco.mj_rayHfield(model, data, floor, start, down, normal)
        assert distance > 0.0, f"no ground under {x}, {y}"
        heights.append(20.0 - distance)
    return np.array(heights)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_heights_are_those_a_ray_cast_finds(kind: str, dtype: torch.dtype) -> None:
    env = make_env(["h1"], 1, task(kind), dtype=dtype)
    surface = env.ground._surface
    points = (2.0 * torch.rand(400, 2, generator=torch.Generator().manual_seed(0)).to(dtype) - 1.0) * surface.extent
    expected = rays_down(env.pool.batches[0].model, points.double().numpy())
    assert np.ptp(expected) > 0.01
    assert np.abs(surface.height(points).double().numpy() - expected).max() < (1e-6 if dtype == torch.float64 else 1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_root_soles_and_scan_are_measured_over_the_ground_under_them(kind: str) -> None:
    env = make_env(["h1"], 1, task(kind), dtype=torch.float64)
    generator = torch.Generator().manual_seed(3)
    root, feet = (torch.rand(8, *shape, generator=generator, dtype=torch.float64) for shape in ((3,), (2, 3)))
    root = (root - 0.5) * torch.tensor([14.0, 38.0, 1.0])
    yaws = np.linspace(-3.0, 3.0, 8)
    quat = torch.stack([quaternion(0.1, -0.2, yaw) for yaw in yaws])
    measured = env.ground.measure(root, quat, root.unsqueeze(1) + feet)
    for row, yaw in enumerate(yaws):
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        here, soles = root[row].numpy(), (root[row] + feet[row]).numpy()
        scan = here[:2] + scan_points(ObservationsCfg()).numpy() @ turn.T
        ground = rays_down(env.pool.batches[0].model, np.concatenate([here[None, :2], soles[:, :2], scan]))
        assert measured["base_height"][row].item() == pytest.approx(here[2] - ground[0], abs=1e-3)
        assert np.allclose(measured["foot_height"][row], soles[:, 2] - ground[1:3], atol=1e-3)
        assert np.allclose(measured["height_scan"][row], ground[3:] - ground[0], atol=1e-3)
    assert measured["height_scan"].abs().max() > 0.01


def test_the_plane_is_flat_and_has_no_levels() -> None:
    assert build_terrain(TerrainCfg(), 0) is None
    env = make_env()
    assert type(env.ground) is Plane
    for _ in rollout(env, 2):
        assert not env.state.height_scan.any()
        assert torch.equal(env.state.base_height, env.state.root_pos_w[:, 2])
        assert torch.equal(env.state.foot_height, env.state.foot_pos_w[..., 2])
    assert env.ground.log(env.robot_names) == {}


def patch(terrain: Terrain, level: int, variant: int) -> Array:
    """Heights of one patch, rows along y, shape (51, 51)."""
    rows, columns = terrain.field.heights.shape
    x, y = terrain.centres[level, variant] / terrain.field.cell_size
    column, row = round(x + (columns - 1) / 2), round(y + (rows - 1) / 2)
    return terrain.field.heights[row - 25 : row + 26, column - 25 : column + 26]


def test_rough_ground_grows_with_the_level_and_stays_within_two_centimetres() -> None:
    terrain = built("rough", cfg=TerrainCfg(num_levels=5, patch_size=5.0))
    spread = [np.abs(terrain.field.heights[:, 40 + 50 * level + 1 : 40 + 50 * (level + 1)]).max() for level in range(5)]
    assert spread[0] == 0.0
    assert spread == sorted(spread)
    assert 0.019 < spread[-1] <= 0.02
    assert np.array_equal(
        terrain.field.heights, built("rough", cfg=TerrainCfg(num_levels=5, patch_size=5.0)).field.heights
    )
    assert not np.array_equal(
        terrain.field.heights, built("rough", 2, TerrainCfg(num_levels=5, patch_size=5.0)).field.heights
    )


def test_slopes_rise_and_fall_at_their_angle_around_a_flat_middle() -> None:
    terrain = built("slopes")
    for level, difficulty in enumerate((0.0, 0.5, 1.0)):
        for variant, sign in ((0, 1.0), (1, -1.0)):
            profile = patch(terrain, level, variant)[25]
            middle = np.abs(np.arange(-25, 26)) * 0.1 <= PLATFORM + 1e-9
            rise = np.tan(0.2 * difficulty)
            assert np.allclose(profile[middle], sign * rise * (2.5 - PLATFORM))
            assert np.allclose(np.abs(np.diff(profile[:11])), 0.1 * rise)
            assert profile[0] == pytest.approx(0.0)


def test_steps_have_their_height() -> None:
    terrain = built("steps")
    for variant, sign in ((0, 1.0), (1, -1.0)):
        profile = patch(terrain, 2, variant)[25]
        assert np.allclose(np.unique(np.round(sign * profile, 9)), [0.0, 0.1, 0.2])
        assert np.count_nonzero(np.diff(profile)) == 4, "two steps on each side"


@pytest.mark.parametrize("kind", KINDS)
def test_patches_meet_without_cliffs(kind: str) -> None:
    heights = built(kind).field.heights
    tallest = {"rough": 0.02, "slopes": 0.1 * np.tan(0.2), "steps": 0.1}[kind] + 1e-9
    for axis in (0, 1):
        assert np.abs(np.diff(heights, axis=axis)).max() <= tallest
    border = round(BORDER / 0.1)
    assert not heights[: border - 1].any()
    assert not heights[:, : border - 1].any()


def test_terrains_nobody_can_walk_or_hold_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"task\.terrain\.patch_size: got 3.0"):
        build_terrain(TerrainCfg(kind="steps", patch_size=3.0), 0)
    with pytest.raises(ConfigError, match=r"task\.terrain: 10 levels .* at most"):
        build_terrain(TerrainCfg(kind="rough", cell_size=0.01), 0)


@pytest.mark.parametrize("kind", KINDS)
def test_robots_start_on_a_patch_of_their_level_and_above_the_ground(kind: str) -> None:
    env = make_env(["h1", "n1"], 40, task(kind))
    assert set(env.ground.level.tolist()) == {0, 1, 2}, "levels 0 to 3, as far as there are"
    for level in (0, 2):
        env.ground.level = torch.full_like(env.ground.level, level)
        env.reset()
        middle = env.ground._centres[level, 0, 0]
        assert (env.state.root_pos_w[:, 0] - middle).abs().max() <= 1.0 + 1e-5
        assert len((env.state.root_pos_w[:, 1] / 5.0).round().unique()) > 3, "variants"
        assert env.state.foot_height.min() > -0.005, "a foot starts in the ground"
        assert (env.state.base_height - env.robots.nominal_height).abs().max() < 0.2
    for _ in rollout(env, 25, scale=0.0):
        pass
    assert not env.pool.causes.any()
    standing = env.state.foot_height[env.state.foot_contact]
    assert len(standing) > 10
    assert standing.abs().median() < 0.01, "feet in contact are on the ground"


def ground(num_envs: int = 4, levels: int = 3, steps: int = 100) -> UnevenGround:
    terrain = built("rough", cfg=replace(SMALL, num_levels=levels))
    rng = CounterRng(0, ["h1"] * num_envs, torch.arange(num_envs))
    robots = torch.zeros(num_envs, dtype=torch.long)
    return UnevenGround(terrain, scan_points(ObservationsCfg()), robots, rng, 0.02, steps)


ROBOTS = random_robots(0, num_envs=4)
IDS = torch.arange(4)


def episode(on: UnevenGround, speed: float, asked: float = 2.0, score: float = 0.9, steps: int = 100) -> PooledState:
    """Walk straight ahead for some steps."""
    state = quiet_state(ROBOTS)
    state.base_lin_vel_b[:, 0], state.command[:, 0] = speed, asked
    for _ in range(steps):
        on.judge(torch.full((4,), score, dtype=torch.float64), state)
    return state


def levels_after(
    start: int, speed: float, count: int = 1, age: int = 0, lean: float = 0.0, x: float = 0.0, **walk: float
) -> list[int]:
    on = ground()
    on.level = torch.full((4,), start)
    state = episode(on, speed, **walk)
    state.projected_gravity_b = torch.tensor([[np.sin(lean), 0.0, -np.cos(lean)]]).repeat(4, 1)
    state.root_pos_w[:, 0] = x
    length = torch.full((4,), int(walk.get("steps", 100)) + age)
    on.advance(IDS, torch.full((4,), count), state, length)
    return on.level.tolist()


def test_good_walkers_go_up_and_poor_ones_down() -> None:
    """2 s at up to 2 m/s; half a patch is 2.5 m."""
    assert levels_after(1, speed=1.9) == [2] * 4
    assert levels_after(1, speed=1.2) == [1] * 4, "half a patch is not reached, half of what was asked is"
    assert levels_after(1, speed=0.9) == [0] * 4, "less than half of what was asked"
    assert levels_after(0, speed=0.1) == [0] * 4, "there is nothing below"
    assert levels_after(1, speed=0.0, asked=0.0) == [1] * 4, "nothing was asked"
    assert levels_after(1, speed=1.9, score=0.7) == [1] * 4, "tracking was poor"
    assert levels_after(1, speed=1.9, lean=0.7) == [1] * 4, "it fell at the end"


def test_a_fall_after_a_short_walk_costs_a_level() -> None:
    assert levels_after(1, speed=1.9, steps=30) == [0] * 4


def test_walking_off_the_world_costs_nothing() -> None:
    assert levels_after(1, speed=1.9, steps=30, x=11.0) == [1] * 4


def test_episodes_without_a_beginning_are_not_judged() -> None:
    assert levels_after(1, speed=0.1, age=37) == [1] * 4
    assert levels_after(1, speed=1.9, age=37) == [1] * 4
    assert levels_after(1, speed=0.1, count=0) == [1] * 4


def test_past_the_top_robots_start_again_anywhere() -> None:
    seen: set[int] = set()
    on = ground()
    for count in range(1, 20):
        on.level = torch.full((4,), 2)
        on.advance(IDS, torch.full((4,), count), episode(on, 1.9), torch.full((4,), 100))
        seen |= set(on.level.tolist())
    assert seen == {0, 1, 2}


def test_only_environments_that_end_change_level() -> None:
    on = ground()
    on.level = torch.full((4,), 1)
    state, ids = episode(on, 0.1), torch.tensor([1, 3])
    on.advance(ids, torch.ones(2, dtype=torch.long), state, torch.full((4,), 100))
    assert on.level.tolist() == [1, 0, 1, 0]
    state = episode(on, 0.1, steps=1)
    on.advance(IDS, torch.ones(4, dtype=torch.long), state, torch.tensor([101, 1, 101, 1]))
    assert on.level.tolist() == [0, 0, 0, 0]


def test_the_end_of_the_world_is_a_time_out_with_its_last_observation() -> None:
    env = make_env(["h1", "g1"], 4, task("rough"))
    half = env.ground._surface.extent
    env.pool.batches[0].qpos[1, 0] = half[0] - 0.5
    _, _, dones, extras = env.step(actions(4, 0))
    assert dones.tolist() == extras["time_outs"].tolist() == [False, True, False, False]
    assert extras["final_ids"].tolist() == [1]
    assert len(extras["final_observations"]["critic"]) == 1
    assert not env.ground.left(env.state.root_pos_w).any(), "it starts again on a patch"


def test_beyond_the_edge_the_ground_goes_on_level() -> None:
    terrain = built("slopes")
    surface = Surface(terrain.field, DOUBLE)
    far = torch.tensor([[1e3, 0.0], [0.0, -1e3], [-1e3, 1e3]], dtype=torch.float64)
    assert surface.height(far).tolist() == [0.0, 0.0, 0.0]


def test_levels_are_logged_for_every_robot() -> None:
    env = make_env(["h1", "g1"], 5, task("rough"))
    env.ground.level = torch.tensor([0, 1, 2, 2, 1])
    logged: dict[str, Tensor] = {}
    for step in range(24):
        env.ground.level = torch.tensor([0, 1, 2, 2, 1])
        logged = env.step(actions(5, step, 0.0))[3]["log"]
    assert float(logged["Curriculum/terrain_level/h1"]) == pytest.approx(1.0)
    assert float(logged["Curriculum/terrain_level/g1"]) == pytest.approx(1.5)


@pytest.mark.parametrize("before", [24, 40])
def test_a_run_on_uneven_ground_resumes_bit_for_bit(before: int) -> None:
    assert_continues(lambda: make_env(task=replace(BUSY, terrain=small("steps"))), before, 60)
