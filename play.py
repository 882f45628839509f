#!/usr/bin/env python3
"""Show a checkpoint: ``python play.py CHECKPOINT --video five.mp4``. The same as ``eagle play``."""

from __future__ import annotations

import sys

try:
    from eagle_rl.cli.main import run_verb
except KeyboardInterrupt:  # so early that nobody listens for it yet
    sys.exit(130)

if __name__ == "__main__":
    sys.exit(run_verb("play", sys.argv[1:]))
