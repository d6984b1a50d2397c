"""Textured, lit scenes by name and seed (rooms, homes, a hall, streets), and mesh files by path."""

from ms_slam_env.scenes.registry import (
    HOMES,
    LARGE_SCENES,
    PUBLISHED_ROOMS,
    ROOMS,
    SCENES,
    SEED_SPLITS,
    make,
    seeds_of,
    split_of,
)
from ms_slam_env.scenes.scene import Scene, TexturedMesh

__all__ = [
    "HOMES",
    "LARGE_SCENES",
    "PUBLISHED_ROOMS",
    "ROOMS",
    "SCENES",
    "SEED_SPLITS",
    "Scene",
    "TexturedMesh",
    "make",
    "seeds_of",
    "split_of",
]
