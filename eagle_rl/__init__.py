"""EAGLE's learner: policies, algorithms and runs over tensors and a ``VecEnv``; it never sees the simulator."""

import os

# rsl_rl imports GitPython, which refuses to load on a machine without a git executable unless told to be quiet.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
