"""Runs: the training loop, its checkpoints and its logs."""
