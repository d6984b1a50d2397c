"""Which surface of a dwelling a camera can see from where it can go, 0.4 to 1.8 m high."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from ms_slam_env.scenes.base import Float64, TexturedMesh
from ms_slam_env.scenes.free_space import FreeSpace
from ms_slam_env.scenes.mesh_queries import RayCaster, face_cross
from ms_slam_env.scenes.mesh_scene import unit_rows

Bool = NDArray[np.bool_]

CAMERA_M = 0.15
"""Free space around a camera that goes about."""
_SPACING_M = 0.4  # between viewpoints
_HEIGHTS_M = (0.4, 1.1, 1.8)  # not from the floor up under tables
_LOOKS = ((6, 1), (240, 5), (700, 7))
"""Each face is looked at from so many nearest viewpoints, or every so many of these; what the
first few do not see from the others, which lie on more sides."""
_HIT = 0.99
_LEAST_COSINE = 0.15
"""Of the angle of incidence: what is seen more obliquely gives a depth camera no reading."""


def reachable_cells(free: FreeSpace, start: Float64, radius_m: float = CAMERA_M) -> Bool:
    """Voxels (nx, ny, nz) that a ball of ``radius_m`` can get to from ``start`` (3,)."""
    component, _ = ndimage.label(free.distance > radius_m)
    at = component[tuple(np.rint((start - free.origin) / free.voxel_m).astype(int))]
    return (component == at) & (at > 0)


def viewpoints(free: FreeSpace, start: Float64) -> Float64:
    """Places (K, 3) in a grid over all of the free space that a camera can reach."""
    step = max(1, round(_SPACING_M / free.voxel_m))
    cells = reachable_cells(free, start)
    heights = np.rint((np.array(_HEIGHTS_M) - free.origin[2]) / free.voxel_m).astype(int)
    grid = np.zeros_like(cells)
    grid[::step, ::step, heights] = True
    return free.origin + free.voxel_m * np.argwhere(cells & grid)


def seen_faces(mesh: TexturedMesh, free: FreeSpace, start: Float64) -> Bool:
    """Which faces (F,) show the middle of their front, which opens into free space, to a viewpoint.

    A few in a hundred that only few places see are missed.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    middle, normal = corners.mean(axis=1), unit_rows(face_cross(corners))
    eyes = viewpoints(free, start)
    rays = RayCaster(mesh.vertices, mesh.faces)
    seen = np.zeros(len(middle), bool)
    opens = np.flatnonzero(free.clearance(middle + 1.2 * free.voxel_m * normal) > 0)
    tree = cKDTree(eyes)
    for nearest, stride in _LOOKS:
        rest = opens[~seen[opens]]
        of_rest = tree.query(middle[rest], min(nearest, len(eyes)))[1][:, ::stride]
        for rank in range(of_rest.shape[1]):
            left = np.flatnonzero(~seen[rest])
            face, eye = rest[left], eyes[of_rest[left, rank]]
            towards = middle[face] - eye
            cosine = -np.einsum("ij,ij->i", towards, normal[face])
            facing = cosine > _LEAST_COSINE * np.linalg.norm(towards, axis=1)
            face, eye, towards = face[facing], eye[facing], towards[facing]
            distance, _ = rays.first_hit(eye, towards)
            seen[face[distance > _HIT]] = True
    return seen
