"""Scenes from mesh files (.glb, .obj, .ply, ...), world z up, metres."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError
from ms_slam_env.scenes import mesh_cache
from ms_slam_env.scenes.builder import Geometry
from ms_slam_env.scenes.free_space import Enclosed, FreeSpace, voxel_for
from ms_slam_env.scenes.lighting import Lamp, Lighting, auto_exposure, light_mesh
from ms_slam_env.scenes.mesh_formats import MESH_SUFFIXES, MeshFile
from ms_slam_env.scenes.mesh_formats.part import MAX_TEXELS, Part
from ms_slam_env.scenes.mesh_queries import RayCaster, face_cross, sample_surface
from ms_slam_env.scenes.mesh_scene import MeshScene, unit_rows
from ms_slam_env.scenes.scene import Rng, TexturedMesh

_GREY = np.array([190, 190, 190], np.uint8)
_MAX_TRIANGLES = 900_000
_BLOCK = 4  # texels per side for a triangle with vertex colours


@dataclass(frozen=True)
class Soup:
    """A triangle soup: triangles that share no vertices.

    Attributes:
        corners: (F, 3, 3) metres.
        uv: (F, 3, 2) u along columns, v along rows from the top.
        texture: (F,) index into ``textures``.
        label: (F,) index into ``labels``.
        textures: (h, w, 3) uint8 sRGB images.
        labels: names of the file's parts.
    """

    corners: Float64
    uv: Float64
    texture: NDArray[np.int64]
    label: NDArray[np.int64]
    textures: tuple[NDArray[np.uint8], ...]
    labels: tuple[str, ...]


def load_soup(name: str | Path) -> Soup:
    """Read a mesh file, given by its path with optional options (see ``MeshOptions``).

    Raises:
        InputError: no such file, not readable as a mesh, or without triangles.
    """
    file = MeshFile.named(name)
    if file is None:
        raise InputError(f"{str(name)!r} is not a mesh file ({', '.join(MESH_SUFFIXES)})")
    corners, uvs, texture, label = [], [], [], []
    images: list[NDArray[np.uint8]] = []
    place: dict[object, int] = {}  # index of each image; parts share images
    texels = 0
    labels: list[str] = []
    for part in file.read():
        if not len(part.faces):
            continue
        triangles = part.vertices[part.faces]
        if not (np.abs(triangles[np.isfinite(triangles)]) <= _MAX_COORDINATE_M).all():
            raise InputError(
                f"mesh file {str(file.path)!r} reaches farther than {_MAX_COORDINATE_M:g} m; "
                + _UNIT
            )
        area = np.linalg.norm(face_cross(triangles), axis=1)
        keep = np.isfinite(triangles).all((1, 2)) & (area > 1e-12)
        key, uv, image = _appearance(part)
        if key not in place:
            place[key] = len(images)
            images.append(image)
            texels += image.shape[0] * image.shape[1]
        if texels > MAX_TEXELS:
            raise InputError(f"mesh file {str(file.path)!r}: its textures are too large together")
        corners.append(triangles[keep])
        uvs.append(uv[keep])
        texture.append(np.full(keep.sum(), place[key]))
        label.append(np.full(keep.sum(), len(labels)))
        labels.append(part.name)
    if sum(len(c) for c in corners) == 0:
        raise InputError(f"mesh file {str(file.path)!r} has no triangles")
    joined = map(np.concatenate, (corners, uvs, texture, label))
    of_corners, of_uv, of_texture, of_label = joined
    return Soup(of_corners, of_uv, of_texture, of_label, tuple(images), tuple(labels))


def split_long_edges(soup: Soup, max_edge_m: float) -> Soup:
    """Bisect the longest edge of triangles until all are at most ``max_edge_m`` long."""
    data = np.concatenate([soup.corners, soup.uv], 2)  # (F, 3, 5)
    index = np.arange(len(data))
    while len(data) < _MAX_TRIANGLES:
        edge = np.linalg.norm(data[:, [1, 2, 0], :3] - data[:, :, :3], axis=2)  # edge k: k to k+1
        longest = edge.argmax(1)
        split = edge.max(1) > max_edge_m
        if not split.any():
            break
        order = (longest[split, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(data[split], order[..., None], 1), 1, 0)
        middle = 0.5 * (a + b)
        halves = np.stack([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        data = np.concatenate([data[~split], *halves])
        index = np.concatenate([index[~split], index[split], index[split]])
    corners, uv = data[..., :3], data[..., 3:]
    return Soup(corners, uv, soup.texture[index], soup.label[index], soup.textures, soup.labels)


def _appearance(part: Part) -> tuple[object, Float64, NDArray[np.uint8]]:
    """Key of a part's image, texture coordinates (F, 3, 2), and the image."""
    tint = None if part.tint is None else tuple(part.tint)
    if part.image is not None and part.uv is not None:
        return (id(part.image), tint), np.nan_to_num(part.uv), _tinted(part.image, part.tint)
    centre = np.full((len(part.faces), 3, 2), 0.5)
    if part.colours is None:
        return tint, centre, _plain(_GREY if part.tint is None else part.tint)
    if (part.colours == part.colours[0, 0]).all():
        return tuple(part.colours[0, 0]), centre, _plain(part.colours[0, 0])
    return id(part), *_colour_atlas(part.colours.astype(np.float32))


def _tinted(image: NDArray[np.uint8], factor: Float64 | None) -> NDArray[np.uint8]:
    """Multiply an image by a colour (3,) in [0, 255].

    glTF multiplies linear light. Multiplying sRGB values is nearly the same, because the curve is
    close to a power.
    """
    if factor is None or not (factor < 255.0).any():
        return image
    return np.rint(image * (factor / 255.0)).astype(np.uint8)


def _colour_atlas(colours: NDArray[np.float32]) -> tuple[Float64, NDArray[np.uint8]]:
    """Make a texture with a block of texels per triangle that interpolates its corners' colours.

    Args:
        colours: (F, 3, 3) at the corners, in [0, 255].
    """
    count = len(colours)
    side = int(np.ceil(np.sqrt(count)))
    step = np.arange(_BLOCK, dtype=np.float32) / (_BLOCK - 1)
    j, i = np.meshgrid(step, step, indexing="ij")
    weight = np.stack([1 - i - j, i, j], -1)  # corner 0 top left, 1 right, 2 below
    texels = np.clip(np.einsum("yxk,fkc->fyxc", weight, colours), 0, 255)
    atlas = np.zeros((side * side, _BLOCK, _BLOCK, 3), np.uint8)
    atlas[:count] = np.rint(texels)
    image = atlas.reshape(side, side, _BLOCK, _BLOCK, 3).swapaxes(1, 2)
    image = image.reshape(side * _BLOCK, side * _BLOCK, 3)
    block = np.stack([np.arange(count) % side, np.arange(count) // side], -1)  # column, row
    corner = np.array([[0.5, 0.5], [_BLOCK - 0.5, 0.5], [0.5, _BLOCK - 0.5]])
    uv = (block[:, None] * _BLOCK + corner) / (side * _BLOCK)
    return uv, np.ascontiguousarray(image)


def _plain(rgb: Any) -> NDArray[np.uint8]:
    return np.broadcast_to(np.asarray(rgb, dtype=np.float64), (4, 4, 3)).astype(np.uint8).copy()


_OF_MESH = ("vertices", "faces", "uv", "face_texture", "face_label", "irradiance")
_MAX_EDGE_M = 0.3
_MAX_COORDINATE_M = 1e4  # largest coordinate of a scene
_UNIT = "where its unit is not the metre, say so, as in 'room.ply,scale=0.01' for centimetres"
_MAX_VOXEL_M = 0.15  # of the free space, enough for about 20,000 cubic metres
_FINENESS = 0.4  # spacing of surface samples, in voxels
_MAX_SAMPLES = 20_000_000
_LAMPS = 10
_KEY = 0.2
_FACING_M = 0.06


def from_file(name: str | Path, seed: int = 0) -> MeshScene:
    """Load a mesh and light it with lamps in its free space.

    Slow steps show progress, and their results are cached on disk (``mesh_cache``). The free space
    is the largest enclosed part (see ``Enclosed``); faces are turned towards it.

    Args:
        name: the file, as in ``load_soup``.
        seed: varies the strength of the lamps.

    Raises:
        InputError: no such file, not readable as a mesh, without triangles, or too large.
    """
    soup = load_soup(name)
    given: list[NDArray[Any]] = [soup.corners, soup.uv, soup.texture, soup.label, *soup.textures]
    entry = mesh_cache.key(given, (seed, soup.labels))
    arrays = mesh_cache.remembered(entry, partial(_light, soup, seed, str(name)))
    free = FreeSpace.of_grid(arrays["distance"], arrays["origin"], float(arrays["voxel_m"]))
    of_mesh = {field: arrays[field] for field in _OF_MESH}
    mesh = TexturedMesh(**of_mesh, textures=soup.textures, labels=soup.labels)
    eyes = _eye_cells(free, _free_cells(free))

    def start(draw: Rng) -> tuple[Float64, Float64]:
        eye = eyes[draw.integers(len(eyes))] + draw.uniform(-0.4, 0.4, 3) * free.voxel_m
        angle, drop = draw.uniform(-np.pi, np.pi), draw.uniform(0.0, 0.4)
        return eye, eye + np.array([np.cos(angle), np.sin(angle), -drop])

    maker = partial(from_file, name)
    return MeshScene(maker, seed, mesh, free, start, float(arrays["exposure"]), name=str(name))


def _check_extent(soup: Soup, name: str) -> float:
    """Voxel size for a mesh's free space; refuse a mesh that is too large.

    Raises:
        InputError: it names the extent, and what to do if the unit is not the metre.
    """
    low, high = soup.corners.min((0, 1)), soup.corners.max((0, 1))
    voxel_m = voxel_for(low, high)
    area = 0.5 * float(np.linalg.norm(face_cross(soup.corners), axis=1).sum())
    if voxel_m > _MAX_VOXEL_M or area > _MAX_SAMPLES * (_FINENESS * voxel_m) ** 2:
        extent = " x ".join(f"{side:.4g}" for side in high - low)
        raise InputError(
            f"mesh {name!r} is too large for a scene: {extent} m, {area:.3g} m2 of surface; {_UNIT}"
        )
    return voxel_m


def _light(soup: Soup, seed: int, name: str) -> mesh_cache.Arrays:
    """Compute a mesh's cached data: the lit mesh, its free space and its exposure.

    Raises:
        InputError: no free space, or too large.
    """
    voxel_m = _check_extent(soup, name)
    title = f"preparing {os.path.basename(name)}"
    with tqdm(total=4, desc=title, unit="stage", disable=None) as bar:
        soup = split_long_edges(soup, _MAX_EDGE_M)
        faces = np.arange(3 * len(soup.corners)).reshape(-1, 3)
        rays = RayCaster(soup.corners.reshape(-1, 3), faces)
        samples, _ = sample_surface(soup.corners.reshape(-1, 3), faces, _FINENESS * voxel_m)
        free = FreeSpace(samples, Enclosed(rays))
        bar.update()
        if not free.distance.any():
            raise InputError(f"mesh {name!r} leaves no free space for a camera")
        geometry = _geometry(_turn_to_free_space(soup, free))
        bar.update()
        cells = _free_cells(free)
        mesh = light_mesh(geometry, _lighting(cells, seed))
        bar.update()
        exposure = auto_exposure(mesh, _spread(cells, 6), _KEY, frozenset())
        bar.update()
    grid = {"distance": free.distance, "origin": free.origin, "voxel_m": np.array(free.voxel_m)}
    lit = {name: getattr(mesh, name) for name in _OF_MESH}
    return {**lit, **grid, "exposure": np.array(exposure)}


def _lighting(cells: Float64, seed: int) -> Lighting:
    """Place lamps in the free space; the seed varies their strength."""
    rng = np.random.default_rng([seed, 7])
    lamps = tuple(
        Lamp(tuple(place), tuple(rng.uniform(0.6, 1.0) * np.array([1.0, 0.95, 0.88])), 0.1, 2)
        for place in _spread(cells, _LAMPS)
    )
    return Lighting(lamps, ambient=(0.15, 0.15, 0.15), bounce_rays=12)


def _turn_to_free_space(soup: Soup, free: FreeSpace) -> Soup:
    """Flip faces whose back, but not front, opens into the free space."""
    c = soup.corners
    normal = unit_rows(face_cross(c))
    centre = c.mean(1)
    front = free.clearance(centre + _FACING_M * normal) > 0
    back = free.clearance(centre - _FACING_M * normal) > 0
    flip = back & ~front
    corners, uv = c.copy(), soup.uv.copy()
    corners[flip] = corners[flip][:, ::-1]
    uv[flip] = uv[flip][:, ::-1]
    return Soup(corners, uv, soup.texture, soup.label, soup.textures, soup.labels)


def _geometry(soup: Soup) -> Geometry:
    """Join corners with equal position and face direction, so that light is computed once there."""
    c = soup.corners
    normal = unit_rows(face_cross(c))
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
    """Centres (N, 3) of the free voxels with the largest clearance, at least the top fifth."""
    wide = min(0.3, float(np.quantile(free.distance[free.distance > 0], 0.8)))
    return free.origin + free.voxel_m * np.argwhere(free.distance >= wide)


def _eye_cells(free: FreeSpace, cells: Float64) -> Float64:
    """Cells 1.0 to 1.6 m above the lowest free one, or all if the space is lower."""
    height = cells[:, 2] - cells[:, 2].min() + float(free.clearance(cells[:1])[0])
    standing = cells[(height > 1.0) & (height < 1.6)]
    return standing if len(standing) else cells


def _spread(cells: Float64, count: int) -> Float64:
    """Up to ``count`` cells from the upper part, spread by farthest-point sampling."""
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
