"""MJX on the CPU: the physics of our G1 alone."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import mujoco
from mujoco import mjx

from .turns import About, Rates, Setting, Stepping, control, serve


def prepare(setting: Setting) -> tuple[About, Callable[[], Rates]]:
    """A compiled control step of all simulations."""
    # With asynchronous dispatch a step of 320 environments once waited forever; without it, it once did so too.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    host = mujoco.MjModel.from_xml_path(setting.model)
    model = mjx.put_model(host)

    def advance(data: Any, target: Any) -> Any:
        return jax.lax.fori_loop(0, setting.decimation, lambda _, d: mjx.step(model, d), data.replace(ctrl=target))

    def take(data: Any, key: Any) -> tuple[Any, Any]:
        key, noise = jax.random.split(key)
        targets = 0.075 * jax.random.normal(noise, (setting.num_envs, host.nu))
        return jax.vmap(advance)(data, targets), key

    step = jax.jit(take)
    start = jax.vmap(lambda _: mjx.make_data(model))(jax.numpy.arange(setting.num_envs))
    state = [jax.block_until_ready(step(start, jax.random.key(0)))]

    def act() -> None:
        state[0] = jax.block_until_ready(step(*state[0]))

    stepping = Stepping(act, setting)
    about = About(
        versions=f"MJX {version('mujoco-mjx')}, JAX {version('jax')}, MuJoCo {version('mujoco')}",
        control=control(setting.decimation, host.opt.timestep),
        threads="XLA's, one a core",
        differs="our G1's model; physics alone: no observations, rewards, resets or learner",
    )
    return about, stepping.rates


if __name__ == "__main__":
    serve(prepare)
