"""Coarser levels of vertices, normals and intensity in which invalid pixels leave no trace.

Averaging over an invalid pixel, or over a depth edge, makes points and grey values that exist
nowhere; they break tracking at the coarse levels. A coarse pixel is the mean of those pixels of
its 2x2 block that are valid and lie near the front-most of them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.launches import Launches

EDGE_FRACTION = 0.03  # pixels of a block further behind the front one than this are another surface


@wp.kernel
def _downsample(
    vertices: wp.array3d(dtype=wp.vec3),
    normals: wp.array3d(dtype=wp.vec3),
    intensity: wp.array3d(dtype=wp.float32),
    edge_fraction: wp.float32,
    columns: wp.int32,  # per thread
    coarse_vertices: wp.array3d(dtype=wp.vec3),
    coarse_normals: wp.array3d(dtype=wp.vec3),
    coarse_intensity: wp.array3d(dtype=wp.float32),
):
    b, v, piece = wp.tid()
    width = coarse_vertices.shape[2]
    for u in range(piece * columns, wp.min((piece + 1) * columns, width)):
        front = wp.float32(1.0e9)
        for i in range(4):
            z = vertices[b, 2 * v + i / 2, 2 * u + i % 2][2]
            if z > 0.0:
                front = wp.min(front, z)
        limit = front * (1.0 + edge_fraction)
        vertex = wp.vec3(0.0, 0.0, 0.0)
        normal = wp.vec3(0.0, 0.0, 0.0)
        grey = wp.float32(0.0)
        count = wp.float32(0.0)
        grey_any = wp.float32(0.0)
        for i in range(4):
            p = vertices[b, 2 * v + i / 2, 2 * u + i % 2]
            value = intensity[b, 2 * v + i / 2, 2 * u + i % 2]
            share = wp.float32(0.0)
            if p[2] > 0.0 and p[2] <= limit:
                share = 1.0
            vertex += share * p
            normal += share * normals[b, 2 * v + i / 2, 2 * u + i % 2]
            grey += share * value
            count += share
            grey_any += value
        per_count = wp.float32(1.0)
        if count > 1.0:
            per_count = 1.0 / count
        coarse_vertices[b, v, u] = vertex * per_count
        coarse_normals[b, v, u] = wp.normalize(normal)  # 0 stays 0
        # The sensor's grey value is good where its depth is missing.
        coarse_intensity[b, v, u] = wp.where(count > 0.0, grey * per_count, 0.25 * grey_any)


@wp.kernel
def _intensity_gradient(
    intensity: wp.array3d(dtype=wp.float32),
    columns: wp.int32,
    gradient: wp.array3d(dtype=wp.vec3),
):
    """Write (intensity, d/du, d/dv) by central differences, one-sided at the border."""
    b, v, piece = wp.tid()
    last = intensity.shape[2] - 1
    above = wp.max(v - 1, 0)
    below = wp.min(v + 1, intensity.shape[1] - 1)
    per_height = 1.0 / float(wp.max(below - above, 1))
    for u in range(piece * columns, wp.min((piece + 1) * columns, last + 1)):
        left = wp.max(u - 1, 0)
        right = wp.min(u + 1, last)
        per_width = wp.where(right - left == 2, 0.5, 1.0)
        gradient[b, v, u] = wp.vec3(
            intensity[b, v, u],
            (intensity[b, v, right] - intensity[b, v, left]) * per_width,
            (intensity[b, below, u] - intensity[b, above, u]) * per_height,
        )


@dataclass(frozen=True)
class Level:
    """One pyramid level; arrays (B, h, w). ``gradient`` holds (I, dI/du, dI/dv)."""

    vertices: wp.array
    normals: wp.array
    intensity: wp.array
    gradient: wp.array | None


class Pyramid:
    """Buffers of the coarse levels; level 0 is the caller's own images."""

    def __init__(
        self,
        batch: int,
        shape: tuple[int, int],
        num_levels: int,
        with_gradient: bool,
        device: str = "cpu",
    ) -> None:
        """Allocate ``num_levels`` levels of images (B, H, W) with (H, W) = ``shape``."""
        self._launches = Launches(device)
        # The CPU runs one thread after another: whole rows. A GPU wants many threads.
        self._columns = 1 if wp.get_device(device).is_cuda else shape[1]
        self._levels: list[Level] = []
        self._with_gradient = with_gradient
        self._coarse: list[Level] = []
        size = (batch, *shape)
        self._gradient = wp.zeros(size, dtype=wp.vec3, device=device) if with_gradient else None
        for _ in range(1, num_levels):
            size = (batch, size[1] // 2, size[2] // 2)
            self._coarse.append(
                Level(
                    vertices=wp.zeros(size, dtype=wp.vec3, device=device),
                    normals=wp.zeros(size, dtype=wp.vec3, device=device),
                    intensity=wp.zeros(size, dtype=wp.float32, device=device),
                    gradient=wp.zeros(size, dtype=wp.vec3, device=device)
                    if with_gradient
                    else None,
                )
            )

    def build(self, vertices: wp.array, normals: wp.array, intensity: wp.array) -> list[Level]:
        """All levels, finest first, of images (B, H, W); the coarse ones overwrite the last."""
        if not self._levels or self._levels[0].vertices is not vertices:
            self._launches.clear()
            self._levels = [Level(vertices, normals, intensity, self._gradient), *self._coarse]
        for index, (fine, coarse) in enumerate(itertools.pairwise(self._levels)):
            key = ("downsample", index)
            if not self._launches.replay(key):
                self._launches.record(
                    key,
                    _downsample,
                    self._dim(coarse),
                    [fine.vertices, fine.normals, fine.intensity, EDGE_FRACTION, self._columns],
                    [coarse.vertices, coarse.normals, coarse.intensity],
                )
        for index, level in enumerate(self._levels if self._with_gradient else ()):
            key = ("gradient", index)
            if not self._launches.replay(key):
                self._launches.record(
                    key,
                    _intensity_gradient,
                    self._dim(level),
                    [level.intensity, self._columns],
                    [level.gradient],
                )
        return self._levels

    def _dim(self, level: Level) -> tuple[int, int, int]:
        """Threads of a kernel that writes ``level``: a piece of a row each."""
        batch, height, width = level.vertices.shape
        return batch, height, -(-width // self._columns)
