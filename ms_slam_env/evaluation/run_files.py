"""The files of a run: cost and alignment of every frame (CSV), and the map (PLY)."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.output_files import write_bytes, write_text
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.run_sequence import SequenceRun
from ms_slam_env.evaluation.tracking_diagnosis import alignment_columns
from ms_slam_env.slam.slam_backend import SlamBackend
from ms_slam_env.slam.volumetric.voxel_grid import load_open3d

COSTS = ("frame_cpu_ms", "frame_ext_ms", "frame_mem_mb", "frame_ene_j")
"""Metrics of one frame that `frame_costs` returns."""


def frame_costs(run: SequenceRun) -> dict[str, Float64]:
    """Cost of each frame (N,), by key; NaN if it is not available.

    Leaves out a frame that was interrupted before it was recorded.
    """
    costs = run.costs[: len(run)]
    values = [(1e3 * cost.cpu_s, 1e3 * cost.ext_s, cost.mem_mb, cost.joules) for cost in costs]
    return dict(zip(COSTS, np.array(values, dtype=np.float64).reshape(-1, 4).T, strict=True))


def write_frames(path: Path, run: SequenceRun) -> None:
    """Write the cost of every frame, its alignment, and why it was refused, as CSV.

    Unknown values are empty.
    """
    costs = frame_costs(run)
    columns = {name: costs[f"frame_{name}"] for name in ("ext_ms", "cpu_ms", "mem_mb", "ene_j")}
    columns |= alignment_columns(run)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["timestamp", "tracking_ok", *columns, "reason", "refusal"])
    for index, (timestamp, result) in enumerate(zip(run.timestamps, run.results, strict=True)):
        values = (_number(name, values[index]) for name, values in columns.items())
        said = result.reason, result.refusal
        writer.writerow([f"{timestamp:.6f}", int(result.tracking_ok), *values, *said])
    write_text(path, text.getvalue())


def _number(name: str, value: float) -> str:
    digits = {"residual_m": 6, "degenerate_directions": 0}.get(name, 3)
    return "" if math.isnan(value) else f"{value:.{digits}f}"


_PLY_NAMES = {"color": ("red", "green", "blue"), "normal": ("nx", "ny", "nz")}
_PLY_TYPES = {"u1": "uchar", "f4": "float"}


def write_ply(
    path: Path, points: NDArray[np.float64], attributes: dict[str, NDArray[np.generic]]
) -> None:
    """Write points (M, 3) and their attributes by name, arrays (M,) or (M, 3), as binary PLY.

    ``color`` is uint8, everything else 32-bit floats.
    """
    columns = {name: np.asarray(points[:, k], "<f4") for k, name in enumerate("xyz")}
    for name, values in attributes.items():
        kind = "u1" if name == "color" else "<f4"
        for k, column in enumerate(np.atleast_2d(values.T)):
            columns[_PLY_NAMES.get(name, (name,))[k]] = column.astype(kind)
    table = np.empty(len(points), dtype=[(name, c.dtype) for name, c in columns.items()])
    for name, column in columns.items():
        table[name] = column
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property {_PLY_TYPES[c.dtype.str[1:]]} {name}" for name, c in columns.items()),
        "end_header",
    ]
    write_bytes(path, "\n".join(lines).encode() + b"\n" + table.tobytes())


MESH = "mesh.ply"
_DEPTH = 9  # of the octree: 512 cells along the longest side
_FARTHEST_SPACINGS = 3.0  # largest distance from the map's points, in units of their spacing


def check_open3d() -> None:
    """Refuse to write a mesh, before any other work, if Open3D is missing.

    Raises:
        InputError: Open3D, or a system library that it needs, is not installed.
    """
    load_open3d("a mesh")


def write_mesh(path: Path, backend: SlamBackend) -> int:
    """Write the surface of a SLAM backend as a coloured mesh (binary PLY).

    Screened Poisson reconstruction (Kazhdan and Hoppe, TOG 2013) closes every surface; triangles
    far from the original points are removed afterwards.

    Returns:
        Number of triangles.

    Raises:
        InputError: no Open3D, or a surface without normals or with too few points.
    """
    open3d = load_open3d("a mesh")
    points, known = backend.surface_points(), backend.map_attributes()
    if "normal" not in known:
        raise InputError("a mesh needs normals, which this backend's surface lacks")
    if len(points) < 100:
        raise InputError(f"a surface of {len(points)} points is too small for a mesh")
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
    """Mask (N,) of the vertices that are close to a point of the surface."""
    tree = cKDTree(points)
    spacing = float(np.median(tree.query(points, k=2)[0][:, 1]))
    return tree.query(vertices)[0] <= max(_FARTHEST_SPACINGS * spacing, 0.02)


def _as_ply(vertices: Any, colors: Any, faces: Any) -> Any:
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    mesh.remove_unreferenced_vertices()
    return mesh.export(file_type="ply")
