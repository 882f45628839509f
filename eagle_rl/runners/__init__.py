"""Training: the extended on-policy runner, checkpoints, and the stages of Algorithm 1."""
