"""Builds a scene's mesh from parametric patches in local frames, with textures in metres."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ms_slam_env._runtime.arrays import Float32, Float64, Int32
from ms_slam_env.scenes.scene import Rng, TexturedMesh


@dataclass(frozen=True)
class Material:
    """A texture and the size of one of its tiles on the surface.

    Attributes:
        texture: index of the image among the builder's textures.
        tile_m: (width, height) in metres that the image covers; None stretches the image over
            the whole patch, as for a picture.
        region: (left, top, right, bottom) of the image part in [0, 1] to stretch.
    """

    texture: int
    tile_m: tuple[float, float] | None = None
    region: tuple[float, float, float, float] = (0.001, 0.001, 0.999, 0.999)


@dataclass(frozen=True)
class Geometry:
    """A mesh without light.

    Attributes:
        vertices: (V, 3) float64 metres.
        normals: (V, 3) float64 smooth unit normals.
        light_points: (V, 3) float64 points where each vertex's light is computed: the vertex moved
            slightly off the surface and away from its patch's border, so that a vertex at a corner
            or edge is not inside a neighbour.
        faces: (F, 3) int32.
        uv: (F, 3, 2) float32.
        face_texture: (F,) int32.
        face_label: (F,) int32.
        textures: sRGB images (h, w, 3) uint8.
        labels: object names.
    """

    vertices: Float64
    normals: Float64
    light_points: Float64
    faces: Int32
    uv: Float32
    face_texture: Int32
    face_label: Int32
    textures: tuple[NDArray[np.uint8], ...]
    labels: tuple[str, ...]

    def lit(self, irradiance: NDArray[np.floating]) -> TexturedMesh:
        """Add light (F, 3, 3) at the face corners."""
        return TexturedMesh(
            vertices=self.vertices.astype(np.float32),
            faces=self.faces,
            uv=self.uv,
            face_texture=self.face_texture,
            face_label=self.face_label,
            irradiance=irradiance.astype(np.float32),
            textures=self.textures,
            labels=self.labels,
        )


def pick(rng: Rng, materials: Sequence[Material]) -> Material:
    """Draw one of the materials."""
    return materials[int(rng.integers(len(materials)))]


class MeshBuilder:
    """Collects patches; every primitive below is one or more of them."""

    def __init__(self, cell_m: float = 0.1, variety: int | None = None) -> None:
        """Start empty.

        Args:
            cell_m: flat patches are cut into cells of at most this size.
            variety: largest number of images per kind before they are reused; None: no limit.
        """
        self.cell_m = cell_m
        self.variety = variety
        self._stocks: dict[str, list[NDArray[np.uint8]]] = {}
        self._pose = np.eye(4)
        self._label = 0
        self._prefix = ""
        self._patches: list[tuple[NDArray, ...]] = []  # the fields of `Geometry` up to the textures
        self._textures: list[NDArray[np.uint8]] = []
        self._labels: list[str] = []
        self._count = 0

    def material(
        self, image: NDArray[np.uint8], tile_m: tuple[float, float] | None = None
    ) -> Material:
        """Register an sRGB image (h, w, 3) and return the material that shows it."""
        for index, known in enumerate(self._textures):
            if known is image:
                return Material(index, tile_m)
        self._textures.append(image)
        return Material(len(self._textures) - 1, tile_m)

    def stocked(
        self, rng: Rng, kind: str, make: Callable[[], NDArray[np.uint8]]
    ) -> NDArray[np.uint8]:
        """Make an image, or reuse one of its kind (see ``variety``)."""
        stock = self._stocks.setdefault(kind, [])
        if self.variety is not None and len(stock) >= self.variety:
            return stock[int(rng.integers(len(stock)))]
        stock.append(make())
        return stock[-1]

    def plain(self, rgb: ArrayLike) -> Material:
        """Return a material of one sRGB colour (0 to 255)."""
        colour = np.clip(np.asarray(rgb, dtype=np.float64), 0, 255).astype(np.uint8)
        return self.material(np.broadcast_to(colour, (4, 4, 3)).copy(), (1.0, 1.0))

    @contextmanager
    def object(self, name: str) -> Iterator[None]:
        """Give every patch added inside the block the label ``name`` (reused if known)."""
        previous = self._label
        name = self._prefix + name
        if name not in self._labels:
            self._labels.append(name)
        self._label = self._labels.index(name)
        yield
        self._label = previous

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Prefix the labels of objects added inside the block with ``name`` and a blank."""
        previous, self._prefix = self._prefix, f"{self._prefix}{name} "
        yield
        self._prefix = previous

    @contextmanager
    def frame(self, origin: ArrayLike, yaw: float = 0.0, pitch: float = 0.0) -> Iterator[None]:
        """Add patches in a frame at ``origin`` (3,).

        The frame is rotated by ``yaw`` radians about z, then by ``pitch`` about its own x axis
        (positive: the front, low y, goes down).
        """
        previous = self._pose
        local = np.eye(4)
        local[:3, :3] = Rotation.from_euler("ZX", [yaw, pitch]).as_matrix()
        local[:3, 3] = np.asarray(origin, dtype=np.float64)
        self._pose = previous @ local
        yield
        self._pose = previous

    def patch(
        self, points: ArrayLike, material: Material, uv: Float64 | None = None, inset: bool = True
    ) -> None:
        """Add a surface given as a grid of points.

        Args:
            points: (n, m, 3); the outside is where (change along m) x (change along n) points.
            material: its texture; columns run along m, rows against n (n goes up the image).
            uv: (n, m, 2) texture coordinates in images; None uses arc lengths over the material's
                tile, or [0, 1] for a stretched material.
            inset: compute the light of border vertices slightly inside the patch.
        """
        grid = np.asarray(points, dtype=np.float64)
        if uv is None:
            uv = _arc_length_uv(grid, material)
        self._add(grid, _grid_normals(grid), uv, material, inset)

    def _add(
        self, grid: Float64, normals: Float64, uv: Float64, material: Material, inset: bool
    ) -> None:
        n, m = grid.shape[:2]
        gather = grid.copy()
        if inset:
            gather[[0, -1]] = 0.8 * gather[[0, -1]] + 0.2 * grid[[min(1, n - 1), max(n - 2, 0)]]
            gather[:, [0, -1]] = (
                0.8 * gather[:, [0, -1]] + 0.2 * gather[:, [min(1, m - 1), max(m - 2, 0)]]
            )
        gather = gather + 0.006 * normals
        faces = _grid_faces(n, m)
        R, t = self._pose[:3, :3], self._pose[:3, 3]
        vertices, normals = grid.reshape(-1, 3) @ R.T + t, normals.reshape(-1, 3) @ R.T
        light_points, corners = gather.reshape(-1, 3) @ R.T + t, uv.reshape(-1, 2)[faces]
        of_faces = (np.full(len(faces), index) for index in (material.texture, self._label))
        patch = (vertices, normals, light_points, faces + self._count, corners, *of_faces)
        self._patches.append(patch)
        self._count += n * m

    def quad(
        self,
        origin: ArrayLike,
        edge_u: ArrayLike,
        edge_v: ArrayLike,
        material: Material,
        uv_offset: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Add the parallelogram origin + [0,1] edge_u + [0,1] edge_v.

        The outside is edge_u x edge_v. ``uv_offset`` (metres along u, v) makes the tiles of
        neighbouring pieces of one wall line up.
        """
        o, u, v = (np.asarray(x, dtype=np.float64) for x in (origin, edge_u, edge_v))
        length_u, length_v = math.sqrt(u @ u), math.sqrt(v @ v)
        s = np.linspace(0, 1, self._cuts(length_u) + 1)[None, :, None]
        t = np.linspace(0, 1, self._cuts(length_v) + 1)[:, None, None]
        grid = o + s * u + t * v
        if material.tile_m is None:
            left, top, right, bottom = material.region
            uv = [left, bottom] + s * [right - left, 0.0] + t * [0.0, top - bottom]
        else:
            w, h = material.tile_m
            uv = [uv_offset[0] / w, 1.0 - uv_offset[1] / h] + s * [length_u / w, 0.0]
            uv = uv - t * [0.0, length_v / h]
        normal = np.array(
            [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
        )
        normals = np.broadcast_to(normal / math.sqrt(normal @ normal), grid.shape)
        self._add(grid, normals, uv, material, inset=True)

    def box(
        self,
        low: ArrayLike,
        high: ArrayLike,
        material: Material,
        skip: str = "",
        top: Material | None = None,
        front: Material | None = None,
    ) -> None:
        """Add an axis-aligned box seen from outside.

        Args:
            low: (3,) lower corner.
            high: (3,) upper corner.
            material: material of all sides.
            skip: sides to leave out, of "xXyYzZ" (lower case: the low side).
            top: material of the upper side instead.
            front: material of the low-y side instead.
        """
        lo, hi = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        x, y, z = np.diag(hi - lo)
        sides = {
            "x": (lo + y, -y, z),
            "X": (lo + x, y, z),
            "y": (lo, x, z),
            "Y": (lo + x + y, -x, z),
            "z": (lo + y, x, -y),
            "Z": (lo + z, x, y),
        }
        for side, (o, u, v) in sides.items():
            if side not in skip:
                special = {"Z": top, "y": front}.get(side)
                self.quad(o, u, v, special or material)

    def lathe(
        self, profile: ArrayLike, material: Material, sides: int = 20, centre: ArrayLike = (0, 0, 0)
    ) -> None:
        """Add a surface of revolution about the z axis through ``centre``.

        Args:
            profile: (n, 2) radius and height; an upward profile shows the outside, a downward one
                the inside.
            material: its texture.
            sides: number of facets around the axis.
            centre: (3,).
        """
        r, z = np.asarray(profile, dtype=np.float64).T
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.stack([np.cos(angle), np.sin(angle)], -1)
        grid = np.concatenate(
            [
                r[:, None, None] * ring[None],
                np.broadcast_to(z[:, None, None], (len(r), sides + 1, 1)),
            ],
            -1,
        )
        self.patch(grid + np.asarray(centre, dtype=np.float64), material, inset=False)

    def pillow(
        self, low: ArrayLike, high: ArrayLike, material: Material, roundness: float = 0.4
    ) -> None:
        """Add a rounded box: a superellipsoid that fills [low, high]; roundness 1 is an ellipsoid.

        Reference: Barr, IEEE CG&A 1(1), 1981.
        """
        lo, hi = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        latitude = np.linspace(-np.pi / 2, np.pi / 2, 13)[:, None]
        longitude = np.linspace(0, 2 * np.pi, 25)[None, :]

        def power(x: Float64) -> Float64:
            return np.sign(x) * np.abs(x) ** roundness

        ring = power(np.cos(latitude))
        x, y = ring * power(np.cos(longitude)), ring * power(np.sin(longitude))
        z = np.broadcast_to(power(np.sin(latitude)), x.shape)
        grid = (lo + hi) / 2 + np.stack([x, y, z], -1) * (hi - lo) / 2
        grid[:, -1] = grid[:, 0]
        tile = material.tile_m or (1.0, 1.0)
        across = hi - lo
        # Looks similar from above and from the front: u along x + y, v along z + y.
        u = (grid[..., 0] + 0.6 * grid[..., 1]) / tile[0]
        v = -(grid[..., 2] + 0.6 * grid[..., 1]) / tile[1]
        if material.tile_m is None:
            u, v = (grid[..., 0] - lo[0]) / across[0], (hi[2] - grid[..., 2]) / across[2]
        self.patch(grid, material, np.stack([u, v], -1), inset=False)

    def sheet(self, points: ArrayLike, material: Material, thickness_m: float = 0.002) -> None:
        """Add a thin surface seen from both sides, from a grid of points (n, m, 3)."""
        grid = np.asarray(points, dtype=np.float64)
        normals = _grid_normals(grid)
        self.patch(grid + 0.5 * thickness_m * normals, material)
        self.patch((grid - 0.5 * thickness_m * normals)[:, ::-1], material)

    def _cuts(self, length: float) -> int:
        return max(1, int(np.ceil(length / self.cell_m)))

    def build(self) -> Geometry:
        """Return everything added so far."""
        columns = map(np.concatenate, zip(*self._patches, strict=True))
        vertices, normals, light_points, faces, uv, face_texture, face_label = columns
        corners = vertices.astype(np.float32).astype(np.float64)[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        keep = np.einsum("ij,ij->i", cross, cross) > 1e-14  # a lathe's pole has degenerate cells
        return Geometry(
            vertices,
            normals,
            light_points,
            faces[keep].astype(np.int32),
            uv[keep].astype(np.float32),
            face_texture[keep].astype(np.int32),
            face_label[keep].astype(np.int32),
            tuple(self._textures),
            tuple(self._labels),
        )


@lru_cache(maxsize=256)
def _grid_faces(n: int, m: int) -> NDArray[np.int64]:
    """Two triangles for each cell of an (n, m) grid of vertices."""
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)


def _arc_length_uv(grid: Float64, material: Material) -> Float64:
    """Texture coordinates (n, m, 2) proportional to the longest row's and column's length."""
    n, m = grid.shape[:2]
    along_m = np.linalg.norm(np.diff(grid, axis=1), axis=-1)  # (n, m-1)
    along_n = np.linalg.norm(np.diff(grid, axis=0), axis=-1)  # (n-1, m)
    u = np.concatenate([[0.0], np.cumsum(along_m[np.argmax(along_m.sum(1))])])
    v = np.concatenate([[0.0], np.cumsum(along_n[:, np.argmax(along_n.sum(0))])])
    if material.tile_m is None:
        left, top, right, bottom = material.region
        u, v = left + u / u[-1] * (right - left), bottom + v / v[-1] * (top - bottom)
    else:
        u, v = u / material.tile_m[0], 1.0 - v / material.tile_m[1]
    return np.stack(np.broadcast_arrays(u[None, :], v[:, None]), -1).reshape(n, m, 2)


def _grid_normals(grid: Float64) -> Float64:
    """Unit normals (n, m, 3) of a grid of points, averaged over the cells that meet there."""
    cell = np.cross(grid[1:, 1:] - grid[:-1, :-1], grid[1:, :-1] - grid[:-1, 1:])
    padded = np.pad(cell, ((1, 1), (1, 1), (0, 0)))
    if np.allclose(grid[:, 0], grid[:, -1]):  # closed around, as a lathe
        padded[:, 0], padded[:, -1] = padded[:, -2], padded[:, 1]
    normals = padded[1:, 1:] + padded[:-1, 1:] + padded[1:, :-1] + padded[:-1, :-1]
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0)
