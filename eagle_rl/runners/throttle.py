"""Warnings that do not fill the screen."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable

from eagle_rl.errors import EagleWarning

WARNING_INTERVAL_S = 60.0


class ThrottledWarning:
    """A warning that is repeated at most once a minute."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Measure time with ``clock`` [s]."""
        self._clock = clock
        self._last = -math.inf

    def __call__(self, message: str) -> None:
        """Warn unless a warning was given within the last minute."""
        now = self._clock()
        if now - self._last >= WARNING_INTERVAL_S:
            self._last = now
            warnings.warn(message, EagleWarning, stacklevel=2)
