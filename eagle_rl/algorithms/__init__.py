"""PPO with the losses of the paper added to it, and the specialists it imitates."""
