#!/usr/bin/env python3
"""Train an experiment: ``python train.py quickstart``. The same as ``eagle train``."""

from __future__ import annotations

import sys

from eagle_rl.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("train", sys.argv[1:]))
