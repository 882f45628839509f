#!/usr/bin/env python3
"""Show a checkpoint: ``python play.py CHECKPOINT --video five.mp4``. The same as ``eagle play``."""

from __future__ import annotations

import sys

from eagle_rl.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("play", sys.argv[1:]))
