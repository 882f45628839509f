"""Random numbers that depend only on (seed, robot, environment, stream, count), never on who else is drawing.

There is no generator state: each number is a hash of its coordinates (finalizers of splitmix64). So adding
a robot or an environment moves nobody else's noise, a resumed run needs only its counters, and CPU and GPU agree.
"""

from __future__ import annotations

import zlib

import torch
from torch import Tensor

_GOLDEN = -7046029254386353131  # 0x9E3779B97F4A7C15 as a signed 64-bit integer
_MIX_1 = -4658895280553007687  # 0xBF58476D1CE4E5B9
_MIX_2 = -7723592293110705685  # 0x94D049BB133111EB


def _times_golden(x: int) -> int:
    """``x * _GOLDEN`` as a signed 64-bit integer, as a tensor would have it."""
    return (x * _GOLDEN + 2**63) % 2**64 - 2**63


def _shift_right(x: Tensor, bits: int) -> Tensor:
    """Logical right shift of int64."""
    return (x >> bits).bitwise_and_((1 << (64 - bits)) - 1)


def _mix(x: Tensor) -> Tensor:
    """Finalizer of splitmix64, a bijection on 64-bit integers that scatters nearby inputs; overwrites ``x``."""
    x.bitwise_xor_(_shift_right(x, 30)).mul_(_MIX_1)
    x.bitwise_xor_(_shift_right(x, 27)).mul_(_MIX_2)
    return x.bitwise_xor_(_shift_right(x, 31))


class CounterRng:
    """Uniform numbers for a pool of environments."""

    def __init__(self, seed: int, robot_names: list[str], env_indices: Tensor) -> None:
        """Derive one key per environment.

        Args:
            seed: seed of the run.
            robot_names: robot of each environment, length N.
            env_indices: index of each environment among those of its robot, shape (N,), int64.
        """
        names = torch.tensor([zlib.crc32(name.encode()) for name in robot_names], device=env_indices.device)
        key = _mix(torch.full_like(env_indices, seed) * _GOLDEN + 1)
        self.key = _mix(_mix(key + names * _GOLDEN) + env_indices * _GOLDEN)
        self._stream_keys: dict[str, Tensor] = {}
        self._columns: dict[int, Tensor] = {}

    def uniform(self, stream: str | Tensor, count: Tensor | int, size: int, ids: Tensor | None = None) -> Tensor:
        """Numbers uniform in [0, 1).

        Args:
            stream: name of what is drawn, or its :meth:`keys`; different names are independent.
            count: how often this was drawn before, the coordinate that makes draws differ: int64, shape (n,), or one
                number or scalar tensor for all.
            size: numbers per environment.
            ids: environments, shape (n,), or None for all.

        Returns:
            Float32 tensor, shape (n, size); 24 random bits each.
        """
        key = self.keys(stream) if isinstance(stream, str) else stream
        key = key if ids is None else key[ids]
        key = key + (_times_golden(count) if isinstance(count, int) else count * _GOLDEN)
        words = _mix(key.unsqueeze(1) + self._column_keys(size)).view(torch.int32)  # two numbers a hash
        return (words[:, :size] >> 8).to(torch.float32).mul_(2.0**-24).add_(0.5)

    def uniform_in(
        self,
        low: float | Tensor,
        high: float | Tensor,
        stream: str | Tensor,
        count: Tensor | int,
        size: int,
        ids: Tensor | None = None,
    ) -> Tensor:
        """Numbers uniform in [low, high), shape (n, size)."""
        return low + (high - low) * self.uniform(stream, count, size, ids)

    def keys(self, stream: str) -> Tensor:
        """One key per environment for a stream, derived at its first use, int64, shape (N,)."""
        if stream not in self._stream_keys:
            self._stream_keys[stream] = _mix(self.key + _times_golden(zlib.crc32(stream.encode())))
        return self._stream_keys[stream]

    def _column_keys(self, size: int) -> Tensor:
        """What tells the hashes of one draw apart, shape (half of ``size``, rounded up,)."""
        if size not in self._columns:
            self._columns[size] = torch.arange(1, (size + 1) // 2 + 1, device=self.key.device) * _MIX_1
        return self._columns[size]
