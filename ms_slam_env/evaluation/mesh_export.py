"""A mesh of an estimated surface, by Poisson reconstruction through Open3D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ms_slam_env.errors import InputError
from ms_slam_env.output_files import write_bytes
from ms_slam_env.slam.base import SlamBackend
from ms_slam_env.slam.volumetric.voxel_grid import load_open3d

MESH = "mesh.ply"
_DEPTH = 9  # of the octree: 512 cells along the longest side
_FARTHEST_SPACINGS = 3.0  # from the map's points, in typical distances between these


def check_open3d() -> None:
    """Refuse a mesh, before any work, where Open3D is missing.

    Raises:
        InputError: it, or a system library that it needs, is not installed.
    """
    load_open3d("a mesh")


def write_mesh(path: Path, backend: SlamBackend) -> int:
    """Write the surface of a SLAM as a mesh (PLY, binary) with colours.

    Screened Poisson reconstruction (Kazhdan and Hoppe, TOG 2013) closes every surface; triangles
    far from the points that it was made of are removed again.

    Returns:
        Number of triangles.

    Raises:
        InputError: no Open3D, or a surface without normals or with too few points.
    """
    open3d = load_open3d("a mesh")
    points, known = backend.surface_points(), backend.map_attributes()
    if "normal" not in known:
        raise InputError("a mesh needs normals, which this backend's surface has not")
    if len(points) < 100:
        raise InputError(f"a surface of {len(points)} points is too little for a mesh")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(np.asarray(known["normal"], dtype=np.float64))
    cloud.colors = open3d.utility.Vector3dVector(known["color"] / 255.0)
    made, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=_DEPTH, n_threads=1
    )
    vertices, faces = np.asarray(made.vertices), np.asarray(made.triangles)
    colors = np.rint(255 * np.clip(np.asarray(made.vertex_colors), 0, 1)).astype(np.uint8)
    kept = _near(vertices, points)[faces].all(axis=1)
    write_bytes(path, _as_ply(vertices, colors, faces[kept]))
    return int(kept.sum())


def _near(vertices: Any, points: Any) -> Any:
    """Which vertices (N,) have a point of the surface beside them."""
    tree = cKDTree(points)
    spacing = float(np.median(tree.query(points, k=2)[0][:, 1]))
    return tree.query(vertices)[0] <= max(_FARTHEST_SPACINGS * spacing, 0.02)


def _as_ply(vertices: Any, colors: Any, faces: Any) -> Any:
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    mesh.remove_unreferenced_vertices()
    return mesh.export(file_type="ply")
