"""Light that changes over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.mesh_queries import RayCaster
from ms_slam_env.scenes.movers.shape import Shape
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import ChangingLight
from ms_slam_env.sequences.perturbations.movers import Track
from ms_slam_env.sequences.perturbations.moving_objects import Places
from ms_slam_env.sequences.perturbations.perturbation import LightPerturbation, random_numbers
from ms_slam_env.sequences.trajectory import PoseInterpolation

_BULB = Shape("box", (), radius_m=0.15, length_m=0.1, width_m=0.1, height_m=0.05, depth_m=0.05)
_NEAREST_M = 0.2  # the lamp's light does not increase below this distance
_DIMMEST = 1e-3  # share of the typical light; less is ignored
_SHADOW_END = 0.999
_TRIES = 2000
_SHORTEST_M = 0.3  # least distance between camera and lamp


@dataclass(frozen=True)
class Illumination(Checked, LightPerturbation):
    """Dims the scene's lights periodically, and adds a small moving lamp that casts shadows.

    Both change linear light before noise and the sRGB curve; depth does not change. The lamp moves
    back and forth in free space, like a box of ``moving-objects``. Its shadows are cast by the
    scene on itself, sampled at triangle corners; the lamp itself is too small to be seen.

    Attributes:
        dim: share of the scene's own light that is missing at the darkest time; 0 = off.
        period_s: time from full light to full light.
        lamp: light that the lamp adds to a surface facing it at 1 m, in units of the scene's median
            light; 0 = off.
        speed_m_s: speed of the lamp.
        seed: seed of the lamp's route, in addition to the sequence's.
    """

    dim: float = bounded(0.6, 0.0, 0.98)
    period_s: float = bounded(4.0, 0.01, 1e6)
    lamp: float = bounded(1.0, 0.0, 1e3)
    speed_m_s: float = bounded(0.8, 1e-3, 100.0)
    seed: int = bounded(0, 0, 2**32)

    def light(
        self, scene: Scene, camera: PoseInterpolation, intrinsics: Intrinsics, seed: int
    ) -> ChangingLight | None:
        """See the base class.

        Raises:
            InputError: no free route for the lamp.
        """
        if self.dim == 0 and self.lamp == 0:
            return None
        lamp = None
        if self.lamp:
            lamp = WanderingLamp(scene, self._way(scene, camera, intrinsics, seed), self.lamp)
        return LampsAndDimmer(self.dim, self.period_s, float(camera.times_s[0]), lamp)

    def _way(
        self, scene: Scene, camera: PoseInterpolation, intrinsics: Intrinsics, seed: int
    ) -> Track:
        """The first free route not too near the camera, in its view if possible."""
        rng = random_numbers(seed, self.seed, name="illumination")
        poses = camera.poses
        eyes = poses[:, :3, 3]
        places = Places(scene, poses, intrinsics, rng)
        for anywhere in (False, True):
            for track in places.tracks(_BULB, self.speed_m_s, _TRIES, anywhere):
                at, _, _ = track.at(camera.times_s)
                if np.linalg.norm(at - eyes, axis=1).min() > _SHORTEST_M:
                    return track
        raise InputError(
            f"illumination: found no free way for a lamp in scene {scene.name!r}, seed "
            f"{scene.seed}; try lamp=0 or another seed"
        )


class WanderingLamp:
    """A moving point light."""

    def __init__(self, scene: Scene, track: Track, strength: float) -> None:
        """Start a lamp with ``strength`` times the scene's median light."""
        mesh = scene.mesh
        self._track = track
        self._rays = RayCaster(mesh.vertices, mesh.faces)
        brightness = mesh.irradiance.mean(axis=(1, 2))
        lit = brightness[brightness > 0]
        self._typical = float(np.median(lit)) if len(lit) else 1.0
        self._intensity = strength * self._typical

    def position(self, time_s: float) -> Float64:
        """Position (3,) at a time."""
        return self._track.at(time_s)[0]

    def light(self, points: Float64, normals: Float64, time_s: float) -> Float64:
        """Light (N,) at points (N, 3) with unit normals (N, 3): I cos / r^2, 0 in shadow."""
        towards = self.position(time_s) - points
        square = np.einsum("ni,ni->n", towards, towards)
        cosine = np.einsum("ni,ni->n", towards, normals) / np.sqrt(np.maximum(square, 1e-12))
        value = self._intensity * np.maximum(cosine, 0.0) / np.maximum(square, _NEAREST_M**2)
        lit = np.flatnonzero(value > _DIMMEST * self._typical)
        distance, _ = self._rays.first_hit(points[lit], towards[lit])
        result = np.zeros(len(points))
        result[lit] = value[lit] * (distance > _SHADOW_END)
        return result


class LampsAndDimmer(ChangingLight):
    """The scene's light, periodically dimmed, plus a lamp's."""

    def __init__(
        self, dim: float, period_s: float, start_s: float, lamp: WanderingLamp | None
    ) -> None:
        """Start at ``start_s`` with full light."""
        self._dim, self._period, self._start, self._lamp = dim, period_s, start_s, lamp
        self.is_added = lamp is not None

    def level(self, time_s: float) -> float:
        """See the base class."""
        turn = 2 * np.pi * (time_s - self._start) / self._period
        return float(1.0 - self._dim * 0.5 * (1.0 - np.cos(turn)))

    def added(self, points: Float64, normals: Float64, time_s: float) -> NDArray[np.float32] | None:
        """See the base class."""
        if self._lamp is None:
            return None
        light = self._lamp.light(points, normals, time_s)
        return np.repeat(light[:, None], 3, axis=1).astype(np.float32)
