#!/usr/bin/env python3
"""Train an experiment: ``python train.py quickstart``. The same as ``eagle train``."""

from __future__ import annotations

import sys

try:
    from eagle_rl.cli.main import run_verb
except KeyboardInterrupt:  # so early that nobody listens for it yet
    sys.exit(130)

if __name__ == "__main__":
    sys.exit(run_verb("train", sys.argv[1:]))
