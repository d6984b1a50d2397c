"""A scene too large for indoor rules: outdoors, or a hall; with named places for routes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ms_slam_env.scenes.base import Float64, Int32, TexturedMesh
from ms_slam_env.scenes.free_space import FreeSpace, Holding
from ms_slam_env.scenes.mesh_scene import MeshScene, StartRule, unit_rows
from ms_slam_env.scenes.sampling import sample_surface

SKY = "sky"
"""Label of the dome that stands for the sky: beyond any range, no surface, no obstacle."""

_VOXEL_M = 0.2
_MOST_POINTS = 3_000_000
_FINENESS = 0.45  # distance between samples of the surface, in voxels


class LargeScene(MeshScene):
    """A mesh scene whose views reach farther, and whose routes are known.

    Attributes:
        places: name to point (3,) on the ground, metres, for routes of a camera.
        lanes: see ``Scene``.
    """

    gaze_m = 7.0
    gaze_gap_m = 0.35  # its grid of clearances is coarse
    start_depth_m = (0.8, 12.0)
    min_start_share = 0.6

    def __init__(
        self,
        name: str,
        seed: int,
        mesh: TexturedMesh,
        start_rule: StartRule,
        exposure: float,
        places: Mapping[str, Float64],
        inside: Float64,
        lid_m: float = 4.5,
        lanes: tuple[tuple[Float64, Float64], ...] = (),
    ) -> None:
        """Put the parts together.

        Args:
            name: by which ``make`` builds the scene again.
            seed: likewise.
            mesh: textured and lit.
            start_rule: candidates of start poses.
            exposure: see ``Scene``.
            places: see above.
            inside: (K, 3) points that the free space holds.
            lid_m: height above which no camera goes; counts as an obstacle.
            lanes: see ``Scene``.
        """
        self.places = dict(places)
        self.lanes = lanes
        self._solid = solid_faces(mesh)
        solid = mesh.vertices[mesh.faces[self._solid]].astype(np.float64)
        self._bounds = solid.min(axis=(0, 1)), solid.max(axis=(0, 1))
        free = _free_space(mesh, self._solid, inside, lid_m)
        super().__init__(name, seed, mesh, free, start_rule, exposure)

    def bounds(self) -> tuple[Float64, Float64]:
        """See the base class; the sky is no surface."""
        return self._bounds[0].copy(), self._bounds[1].copy()

    def surface_points(self, spacing_m: float = 0.01) -> tuple[Float64, Int32]:
        """See the base class; the sky is no surface.

        There are ``_MOST_POINTS`` at most, farther apart if they must be: a street has thousands
        of square metres.
        """
        faces = self.mesh.faces[self._solid]
        corners = self.mesh.vertices[faces].astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
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
    """Free space below a lid at height ``lid_m``, which keeps the insides of houses apart."""
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
