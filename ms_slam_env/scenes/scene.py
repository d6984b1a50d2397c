"""The scene interface: textured, lit geometry with free space, start poses and true surface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float32, Float64, Int32

Rng = np.random.Generator

_FLOOR = "floor"
_MET_M = 0.02  # points closer to a surface than this are on it


@dataclass(frozen=True)
class TexturedMesh:
    """A triangle mesh with textures, object labels and baked light.

    The radiance leaving a surface point is diffuse: linear(albedo texel) * irradiance, where the
    irradiance (ambient, sun or lamps with shadows) was computed once per face corner.

    Attributes:
        vertices: (V, 3) float32, world frame, metres, z up.
        faces: (F, 3) int32 vertex indices, counter-clockwise seen from outside.
        uv: (F, 3, 2) float32 texture coordinates of the corners; textures repeat outside [0, 1),
            u along the texture's columns, v along its rows.
        face_texture: (F,) int32 index into ``textures``.
        face_label: (F,) int32 index into ``labels``.
        irradiance: (F, 3, 3) float32 linear RGB light at the corners, 1.0 = nominal white.
        textures: sRGB albedo images, each (h, w, 3) uint8.
        labels: name of each object; one object is one label.
    """

    vertices: Float32
    faces: Int32
    uv: Float32
    face_texture: Int32
    face_label: Int32
    irradiance: Float32
    textures: tuple[NDArray[np.uint8], ...]
    labels: tuple[str, ...]


class Scene(ABC):
    """A world in which a camera can move."""

    name: str
    seed: int
    mesh: TexturedMesh
    exposure: float  # factor from linear radiance to sensor value before the sRGB curve
    gaze_m: float = 2.4
    """Largest distance of the things that a hand-held camera looks at."""
    gaze_gap_m: float = 0.05
    """Length of the line of sight, just before their surface, that need not be free."""
    clearance_grid_m: float = 0.05
    """Largest error by which ``clearance`` may be too small: a grid's edge."""
    passage_m: float = np.inf
    """Width of the narrowest passages on walking routes."""
    lanes: tuple[tuple[Float64, Float64], ...] = ()
    """Straight car lanes: start and end points (3,) on the ground."""

    def bounds(self) -> tuple[Float64, Float64]:
        """Lower and upper corner (3,) of the bounding box of all surfaces, metres."""
        vertices = self.mesh.vertices
        return vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)

    @abstractmethod
    def clearance(self, points: Float64) -> Float64:
        """Distance (N,) in metres from points (N, 3) to the nearest surface.

        0 for points inside an object or outside the scene.
        """

    @abstractmethod
    def segment_is_free(self, start: Float64, end: Float64, radius_m: float) -> bool:
        """Whether a ball of ``radius_m`` can move from ``start`` (3,) to ``end`` (3,) freely."""

    def segments_are_free(self, start: Float64, ends: Float64, radius_m: float) -> Bool:
        """Which (N,) of ``ends`` (N, 3) a ball of ``radius_m`` can reach from ``start`` (3,)."""
        return np.array([self.segment_is_free(start, end, radius_m) for end in ends], dtype=bool)

    def way(self, start: Float64, end: Float64) -> Float64:
        """Walking route (K, 3) on the ground from one point (3,) to another."""
        return np.stack([start, end])

    @abstractmethod
    def sample_start(self, rng: Rng) -> Float64:
        """Draw a start pose T_world_camera (4, 4) in free space with furniture in view."""

    @abstractmethod
    def surface_points(self, spacing_m: float = 0.01) -> tuple[Float64, Int32]:
        """True surface as points (N, 3) about ``spacing_m`` apart and their labels (N,)."""


def words(position: Float64) -> str:
    """Format a position (3,) to the millimetre."""
    return str(np.round(position, 3).tolist())


def floor_height(scene: Scene) -> float:
    """Height of the floor, or of the lowest surface if nothing has that label.

    In a scene of several rooms each has its own floor, such as "kitchen floor".
    """
    mesh = scene.mesh
    floors = [k for k, name in enumerate(mesh.labels) if name.split(" ")[-1] == _FLOOR]
    if not floors:
        return float(scene.bounds()[0][2])
    floor = mesh.faces[np.isin(mesh.face_label, floors)]
    return float(mesh.vertices[floor.ravel(), 2].min())


def outside(scene: Scene, position: Float64) -> str:
    """Describe how a position (3,) is outside a scene's bounding box; empty if inside."""
    low, high = scene.bounds()
    low[2] = floor_height(scene)  # plant leaves may extend through it
    if ((position >= low - _MET_M) & (position <= high + _MET_M)).all():
        return ""
    low, high = (np.round(corner, 2) + 0.0 for corner in (low, high))  # avoids -0.0
    aside = (position[:2] < low[:2] - _MET_M) | (position[:2] > high[:2] + _MET_M)
    if position[2] < low[2] and not aside.any():
        return f"below the floor of scene {scene.name}, which is at z = {low[2]:.2f} m"
    extent = " x ".join(f"{a:.2f} to {b:.2f}" for a, b in zip(low, high, strict=True))
    return f"outside scene {scene.name}, which spans {extent} m"


def enclosed(scene: Scene, position: Float64) -> str:
    """Describe why a position (3,) is not free: outside or inside something; empty if free."""
    if scene.clearance(position[None])[0] > 0:
        return ""
    return outside(scene, position) or f"inside something in scene {scene.name}"
