"""Textured, lit scenes: procedural rooms by name and seed, and mesh files by path."""

from ms_slam_env.scenes.base import Scene, TexturedMesh
from ms_slam_env.scenes.registry import SCENES, SEED_SPLITS, make, split_of

__all__ = ["SCENES", "SEED_SPLITS", "Scene", "TexturedMesh", "make", "split_of"]
