"""Objects that move through a scene: where they can go, how they go there, who sees them."""

from ms_slam_env.sequences.perturbations.moving.mover import Mover, bodies_of
from ms_slam_env.sequences.perturbations.moving.tracks import Track

__all__ = ["Mover", "Track", "bodies_of"]
