"""A scene from a mesh file (.glb, .obj, .ply, ...), world z up, metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.errors import InputError
from ms_slam_env.scenes.base import Float64
from ms_slam_env.scenes.builder import Geometry
from ms_slam_env.scenes.enclosure import Enclosed
from ms_slam_env.scenes.free_space import VOXEL_M, FreeSpace
from ms_slam_env.scenes.lighting import Lamp, Lighting, auto_exposure, light_mesh
from ms_slam_env.scenes.mesh_scene import MeshScene
from ms_slam_env.scenes.rays import RayCaster
from ms_slam_env.scenes.sampling import sample_surface
from ms_slam_env.scenes.triangle_soup import Soup, load_soup, split_long_edges

_MAX_EDGE_M = 0.3
_LAMPS = 10
_KEY = 0.2
_FACING_M = 0.06


def from_file(path: Path, seed: int = 0) -> MeshScene:
    """Load a mesh and light it with lamps in its free space.

    The free space is the largest enclosed part (see ``Enclosed``); faces are turned towards it.

    Args:
        path: of the file.
        seed: varies the strength of the lamps.

    Raises:
        InputError: no such file, not readable as a mesh, or without a triangle.
    """
    soup = split_long_edges(load_soup(path), _MAX_EDGE_M)
    faces = np.arange(3 * len(soup.corners)).reshape(-1, 3)
    rays = RayCaster(soup.corners.reshape(-1, 3), faces)
    samples, _ = sample_surface(soup.corners.reshape(-1, 3), faces, 0.4 * VOXEL_M)
    free = FreeSpace(samples, Enclosed(rays))
    if not free.distance.any():
        raise InputError(f"mesh {str(path)!r} leaves no free space for a camera")
    soup = _turn_to_free_space(soup, free)
    geometry = _geometry(soup)
    rng = np.random.default_rng([seed, 7])
    cells = _free_cells(free)
    lamps = tuple(
        Lamp(tuple(place), tuple(rng.uniform(0.6, 1.0) * np.array([1.0, 0.95, 0.88])), 0.1, 2)
        for place in _spread(cells, _LAMPS)
    )
    mesh = light_mesh(geometry, Lighting(lamps, ambient=(0.15, 0.15, 0.15), bounce_rays=12))
    focus = _spread(cells, 6)
    exposure = auto_exposure(mesh, focus, _KEY, frozenset())
    eyes = _eye_cells(free, cells)

    def start(draw: np.random.Generator) -> tuple[Float64, Float64]:
        eye = eyes[draw.integers(len(eyes))] + draw.uniform(-0.4, 0.4, 3) * free.voxel_m
        angle, drop = draw.uniform(-np.pi, np.pi), draw.uniform(0.0, 0.4)
        return eye, eye + np.array([np.cos(angle), np.sin(angle), -drop])

    return MeshScene(str(path), seed, mesh, free, start, exposure)


def _turn_to_free_space(soup: Soup, free: FreeSpace) -> Soup:
    """Flip the faces whose back, but not front, opens into the free space."""
    c = soup.corners
    normal = _unit(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]))
    centre = c.mean(1)
    front = free.clearance(centre + _FACING_M * normal) > 0
    back = free.clearance(centre - _FACING_M * normal) > 0
    flip = back & ~front
    corners, uv = c.copy(), soup.uv.copy()
    corners[flip] = corners[flip][:, ::-1]
    uv[flip] = uv[flip][:, ::-1]
    return Soup(corners, uv, soup.texture, soup.label, soup.textures, soup.labels)


def _geometry(soup: Soup) -> Geometry:
    """Join corners that share place and face direction, so that light is gathered once there."""
    c = soup.corners
    normal = _unit(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]))
    inset = 0.9 * c + 0.1 * c.mean(1, keepdims=True) + 0.006 * normal[:, None]
    normals = np.repeat(normal, 3, 0)
    key = np.concatenate([np.rint(c.reshape(-1, 3) * 2000), np.rint(normals * 8)], 1)
    _, first, index = np.unique(
        key.astype(np.int32), axis=0, return_index=True, return_inverse=True
    )
    return Geometry(
        vertices=c.reshape(-1, 3)[first],
        normals=normals[first],
        light_points=inset.reshape(-1, 3)[first],
        faces=index.reshape(-1, 3).astype(np.int32),
        uv=soup.uv.astype(np.float32),
        face_texture=soup.texture.astype(np.int32),
        face_label=soup.label.astype(np.int32),
        textures=soup.textures,
        labels=soup.labels,
    )


def _free_cells(free: FreeSpace) -> Float64:
    """Centres (N, 3) of the free voxels that are widest, at least the widest fifth."""
    wide = min(0.3, float(np.quantile(free.distance[free.distance > 0], 0.8)))
    return free.origin + free.voxel_m * np.argwhere(free.distance >= wide)


def _eye_cells(free: FreeSpace, cells: Float64) -> Float64:
    """Cells at 1.0 to 1.6 m above the lowest free one, or all if the space is not that high."""
    height = cells[:, 2] - cells[:, 2].min() + float(free.clearance(cells[:1])[0])
    standing = cells[(height > 1.0) & (height < 1.6)]
    return standing if len(standing) else cells


def _spread(cells: Float64, count: int) -> Float64:
    """Up to ``count`` cells far from one another (farthest-point sampling), from the upper part."""
    high = cells[cells[:, 2] >= np.quantile(cells[:, 2], 0.6)]
    high = high[:: max(1, len(high) // 20_000)]
    chosen = [high[len(high) // 2]]
    distance = np.linalg.norm(high - chosen[0], axis=1)
    for _ in range(count - 1):
        if distance.max() < 0.5:
            break
        chosen.append(high[int(np.argmax(distance))])
        distance = np.minimum(distance, np.linalg.norm(high - chosen[-1], axis=1))
    return np.array(chosen)


def _unit(v: NDArray[np.float64]) -> Float64:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
