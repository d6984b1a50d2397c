"""Scenes made of one lit mesh, its free space and a rule for start poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ms_slam_env._runtime.arrays import Bool, Float64, Int32
from ms_slam_env.geometry import look_at, so3_exp
from ms_slam_env.scenes.free_space import VOXEL_M, FreeSpace, Holding
from ms_slam_env.scenes.mesh_queries import RayCaster, face_cross, sample_surface
from ms_slam_env.scenes.scene import Rng, Scene, TexturedMesh

StartRule = Callable[[Rng], tuple[Float64, Float64]]
"""Draws a candidate start pose (eye (3,), target (3,))."""

SceneMaker = Callable[[int], Scene]
"""Builds a scene from a seed."""

MIN_START_CLEARANCE_M = 0.25
START_DEPTH_M = (0.5, 3.5)
MIN_START_SHARE = 0.8
_TRIES = 2000
_FACING_M = 0.06
_ASIDE_M = 0.04
_MOST_OPEN_POINTS = 20_000_000


class MeshScene(Scene):
    """A scene that is defined by its mesh."""

    start_depth_m = START_DEPTH_M
    min_start_share = MIN_START_SHARE

    def __init__(
        self,
        maker: SceneMaker,
        seed: int,
        mesh: TexturedMesh,
        free_space: FreeSpace,
        start_rule: StartRule,
        exposure: float = 1.0,
        start_objects: int = 2,
        name: str = "",
    ) -> None:
        """Assemble the scene.

        Args:
            maker: builds the same scene again from ``seed``.
            seed: seed of the scene.
            mesh: textured and lit mesh.
            free_space: free space of the mesh.
            start_rule: draws candidate start poses.
            exposure: see ``Scene``.
            start_objects: number of labels that a start pose must have in view.
            name: name of the scene; the maker's by default.
        """
        self.name = name or maker.__name__
        self._maker = maker
        self.seed = seed
        self.mesh = mesh
        self.exposure = exposure
        self._start_rule = start_rule
        self.free_space = free_space
        self.clearance_grid_m = free_space.voxel_m
        self._start_objects = start_objects
        self._rays = RayCaster(mesh.vertices, mesh.faces)

    def clearance(self, points: Float64) -> Float64:
        """See the base class."""
        return self.free_space.clearance(points)

    def segment_is_free(self, start: Float64, end: Float64, radius_m: float) -> bool:
        """See the base class."""
        return bool(self.free_space.segments_are_free(start, end[None], radius_m)[0])

    def segments_are_free(self, start: Float64, ends: Float64, radius_m: float) -> Bool:
        """See the base class."""
        return self.free_space.segments_are_free(start, ends, radius_m)

    def sample_start(self, rng: Rng) -> Float64:
        """See the base class; the best candidate if none meets all conditions."""
        best, best_score = np.eye(4), -1.0
        for _ in range(_TRIES):
            eye, target = self._start_rule(rng)
            clearance = float(self.clearance(eye[None])[0])
            if clearance < MIN_START_CLEARANCE_M:
                continue
            T = look_at(eye, target)
            T[:3, :3] = T[:3, :3] @ so3_exp(np.array([0.0, 0.0, rng.normal(0.0, 0.02)]))
            share, objects = self._view_quality(T)
            if share >= self.min_start_share and objects >= self._start_objects:
                return T
            if share + 0.1 * min(objects, self._start_objects) > best_score:
                best, best_score = T, share + 0.1 * min(objects, self._start_objects)
        return best

    def _view_quality(self, T_world_camera: Float64) -> tuple[float, int]:
        """Share of the view at suitable depth, and the number of objects in view."""
        u, v = np.meshgrid(np.linspace(-0.55, 0.55, 12), np.linspace(-0.42, 0.42, 9))
        rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], -1)
        origins = np.broadcast_to(T_world_camera[:3, 3], rays.shape)
        depth, face = self._rays.first_hit(origins, rays @ T_world_camera[:3, :3].T)
        nearest, farthest = self.start_depth_m
        good = (depth >= nearest) & (depth <= farthest)
        return float(good.mean()), len(np.unique(self.mesh.face_label[face[face >= 0]]))

    def surface_points(self, spacing_m: float = 0.01) -> tuple[Float64, Int32]:
        """See the base class.

        Points whose front does not open into free space (backs of furniture against a wall, insides
        of boxes) are left out, since no camera can see them. Before that there are at most 20
        million points, spaced wider if necessary.
        """
        return self._open_points(None, spacing_m, _MOST_OPEN_POINTS)

    def _open_points(
        self, faces: Int32 | None, spacing_m: float, most: float = np.inf
    ) -> tuple[Float64, Int32]:
        """Points (N, 3) on some or all faces whose front opens into free space, and labels (N,)."""
        mesh = self.mesh
        chosen = mesh.faces if faces is None else mesh.faces[faces]
        corners = mesh.vertices[chosen].astype(np.float64)
        if np.isfinite(most):
            area = 0.5 * float(np.linalg.norm(face_cross(corners), axis=1).sum())
            spacing_m = max(spacing_m, (area / most) ** 0.5)
        points, face = sample_surface(mesh.vertices, chosen, spacing_m)
        tangent = corners[:, 1] - corners[:, 0]
        normal = unit_rows(face_cross(corners))
        tangent = unit_rows(tangent)
        bitangent = np.cross(normal, tangent)
        before = points + _FACING_M * normal[face]
        visible = self.clearance(before) > 0.0
        # In an inner corner the neighbour occupies the space in front: test beside it too.
        for aside in (tangent, -tangent, bitangent, -bitangent):
            rest = np.flatnonzero(~visible)
            visible[rest] = self.clearance(before[rest] + _ASIDE_M * aside[face[rest]]) > 0.0
        labels = mesh.face_label if faces is None else mesh.face_label[faces]
        return points[visible], labels[face[visible]]

    def __reduce__(self) -> tuple[object, tuple[int]]:
        """Pickle only maker and seed: the scene is rebuilt from them, bit for bit."""
        return self._maker, (self.seed,)


def free_space_around(mesh: TexturedMesh, inside: Float64) -> FreeSpace:
    """Free space of a closed room that contains the points ``inside`` (K, 3)."""
    points, _ = sample_surface(mesh.vertices, mesh.faces, 0.4 * VOXEL_M)
    return FreeSpace(points, Holding(np.asarray(inside, dtype=np.float64)))


def unit_rows(vectors: Float64) -> Float64:
    """Normalise vectors (N, 3)."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


SKY = "sky"
"""Label of the sky dome: out of range, neither surface nor obstacle."""

_VOXEL_M = 0.2
_MOST_POINTS = 3_000_000
_FINENESS = 0.45  # spacing of surface samples, in voxels


class LargeScene(MeshScene):
    """A mesh scene with longer views and known routes.

    Attributes:
        places: points (3,) on the ground by name, metres, for camera routes.
        lanes: see ``Scene``.
    """

    gaze_m = 7.0
    gaze_gap_m = 0.35  # its clearance grid is coarse
    start_depth_m = (0.8, 12.0)
    min_start_share = 0.6

    def __init__(
        self,
        maker: SceneMaker,
        seed: int,
        mesh: TexturedMesh,
        start_rule: StartRule,
        exposure: float,
        places: Mapping[str, Float64],
        inside: Float64,
        lid_m: float = 4.5,
        lanes: tuple[tuple[Float64, Float64], ...] = (),
    ) -> None:
        """Assemble the scene.

        Args:
            maker: builds the same scene again from ``seed``.
            seed: seed of the scene.
            mesh: textured and lit mesh.
            start_rule: draws candidate start poses.
            exposure: see ``Scene``.
            places: see the class.
            inside: (K, 3) points that the free space contains.
            lid_m: height that no camera exceeds; counts as an obstacle.
            lanes: see ``Scene``.
        """
        self.places = dict(places)
        self.lanes = lanes
        self._solid = solid_faces(mesh)
        solid = mesh.vertices[mesh.faces[self._solid]].astype(np.float64)
        self._bounds = solid.min(axis=(0, 1)), solid.max(axis=(0, 1))
        free = _free_space(mesh, self._solid, inside, lid_m)
        super().__init__(maker, seed, mesh, free, start_rule, exposure)

    def bounds(self) -> tuple[Float64, Float64]:
        """See the base class; the sky is no surface."""
        return self._bounds[0].copy(), self._bounds[1].copy()

    def surface_points(self, spacing_m: float = 0.01) -> tuple[Float64, Int32]:
        """See the base class; the sky is no surface.

        At most ``_MOST_POINTS``, spaced wider if necessary: a street has thousands of square
        metres.
        """
        faces = self.mesh.faces[self._solid]
        corners = self.mesh.vertices[faces].astype(np.float64)
        cross = face_cross(corners)
        area = 0.5 * float(np.linalg.norm(cross, axis=1).sum())
        spacing = max(spacing_m, (area / _MOST_POINTS) ** 0.5)
        points, sampled = sample_surface(self.mesh.vertices, faces, spacing)
        normal = unit_rows(cross)
        before = points + 0.8 * self.free_space.voxel_m * normal[sampled]
        visible = self.clearance(before) > 0.0
        return points[visible], self.mesh.face_label[self._solid[sampled[visible]]]


def solid_faces(mesh: TexturedMesh) -> Int32:
    """Indices (S,) of the faces that are not sky."""
    if SKY not in mesh.labels:
        return np.arange(len(mesh.faces), dtype=np.int32)
    return np.flatnonzero(mesh.face_label != mesh.labels.index(SKY)).astype(np.int32)


def _free_space(mesh: TexturedMesh, solid: Int32, inside: Float64, lid_m: float) -> FreeSpace:
    """Free space below a lid at height ``lid_m``, which separates the insides of houses."""
    faces = mesh.faces[solid]
    below = mesh.vertices[faces, 2].min(axis=1) < lid_m
    points, _ = sample_surface(mesh.vertices, faces[below], _FINENESS * _VOXEL_M)
    points = points[points[:, 2] < lid_m]
    low, high = points.min(0), points.max(0)
    step = _FINENESS * _VOXEL_M
    x, y = np.meshgrid(np.arange(low[0], high[0] + step, step), np.arange(low[1], high[1], step))
    lid = np.stack([x.ravel(), y.ravel(), np.full(x.size, lid_m)], -1)
    rule = Holding(np.asarray(inside, dtype=np.float64))
    return FreeSpace(np.concatenate([points, lid]), rule, _VOXEL_M)
