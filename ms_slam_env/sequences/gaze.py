"""What a camera looks at from a waypoint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.scenes.base import Scene
from ms_slam_env.sequences.path_shape import unit

Float64 = NDArray[np.float64]

_NEAREST_M = 0.6
_MAX_SLOPE = 0.8  # sine of the angle above or below the horizon
_LOOKS = 10


class Gaze:
    """Chooses visible surface points of a scene at a distance that a depth camera sees well."""

    def __init__(self, scene: Scene) -> None:
        """Sample the scene's surface."""
        self.scene = scene
        self.surface, self.labels = scene.surface_points(0.1)

    def choose(
        self,
        eye: Float64,
        cones: Sequence[tuple[Float64, float]],
        rng: np.random.Generator,
        farthest_m: float | None = None,
    ) -> Float64 | None:
        """A surface point (3,) that ``eye`` (3,) sees; None if there is none.

        Args:
            eye: position of the camera.
            cones: unit vectors (3,) and the angles in radians within which it must lie of each.
            rng: draws among the suitable points.
            farthest_m: largest distance from the camera; by default that of the scene.
        """
        farthest_m = self.scene.gaze_m if farthest_m is None else farthest_m
        offsets = self.surface - eye
        distance = np.linalg.norm(offsets, axis=1)
        slope = np.abs(offsets[:, 2]) / np.maximum(distance, 1e-9)
        is_suitable = (distance > _NEAREST_M) & (distance < farthest_m) & (slope < _MAX_SLOPE)
        for axis, angle_rad in cones:
            is_suitable &= offsets @ axis / np.maximum(distance, 1e-9) > np.cos(angle_rad)
        suitable = np.flatnonzero(is_suitable)
        if not len(suitable):
            return None
        # Every object is as likely as a whole wall: people look at things.
        weights = 1.0 / np.bincount(self.labels[suitable])[self.labels[suitable]]
        count = min(_LOOKS, len(suitable))
        drawn = rng.choice(suitable, count, replace=False, p=weights / weights.sum())
        for target in self.surface[drawn]:
            short = target - self.scene.gaze_gap_m * unit(target - eye)
            if self.scene.segment_is_free(eye, short, 0.01):
                return target
        return None
