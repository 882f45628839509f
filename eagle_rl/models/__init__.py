"""Networks: the embodiment-aware actor and its masked action distribution. The critic is rsl_rl's ``MLPModel``."""

from eagle_rl.models.actor import EagleActor
from eagle_rl.models.distribution import MaskedGaussian

__all__ = ["EagleActor", "MaskedGaussian"]
