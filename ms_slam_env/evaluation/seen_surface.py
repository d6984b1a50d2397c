"""The true surface that the frames of a sequence saw, with which maps are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.geometry.point_clouds import voxel_downsample
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sequences import CameraPath, Sequence

SURFACE_SPACING_M = 0.01
CUTOFF_M = 5.0
"""Largest depth that counts as seen, also if SLAM uses more; the simulated sensor's range."""

_MOST_VIEWS = 60  # neighbouring frames see the same surface
_PIECE_M = 2.7  # larger faces are divided, so that those out of reach are left out
_BEHIND_M = 0.002  # a point so far behind the surface that a ray meets is on it: rounding


def seen_surface(sequence: Sequence, cutoff_m: float = CUTOFF_M) -> Float64:
    """Points (M, 3), `SURFACE_SPACING_M` apart, that at most 60 frames saw within ``cutoff_m``.

    They come from the noise-free depth of a rendered sequence or the depth of a recording, placed
    by the true poses, which must be known.

    Raises:
        InputError: no reading at all, or none up to ``cutoff_m``.
    """
    sequence.check_depth()
    picked = np.unique(np.linspace(0, len(sequence) - 1, _MOST_VIEWS).astype(np.int64))
    clouds = [
        back_projected(
            sequence.true_depth(int(k)), sequence.poses[k], sequence.intrinsics, cutoff_m
        )
        for k in picked
    ]
    cloud = np.concatenate(clouds)
    if not len(cloud):
        raise InputError(f"sequence {sequence.name}: no depth reading up to {cutoff_m:g} m")
    return voxel_downsample(cloud, SURFACE_SPACING_M)


def back_projected(
    depth: NDArray[np.float32], T_world_camera: Float64, intrinsics: Intrinsics, cutoff_m: float
) -> Float64:
    """World points (M, 3) of the readings of ``depth`` (H, W), metres, up to ``cutoff_m``."""
    valid = (depth > 0) & (depth <= cutoff_m)
    return (intrinsics.rays()[valid] * depth[valid, None]) @ T_world_camera[
        :3, :3
    ].T + T_world_camera[:3, 3]


def surface_in_views(
    scene: Scene, poses: Float64, intrinsics: Intrinsics, depth_m: float, spacing_m: float
) -> Float64:
    """Points (M, 3) of a scene's surface that a camera sees, uniform by area.

    The faces get one point per ``spacing_m`` squared, always the same ones; those stay that some
    view shows, unoccluded, at a depth of at most ``depth_m``. Surface counts by its area, however
    often and from how near it is seen, and wherever it lies: in a voxel grid, readings of a plane
    on the border of two layers of voxels count twice.

    Args:
        scene: static scene.
        poses: (N, 4, 4) T_world_camera of the views.
        intrinsics: of the camera.
        depth_m: largest depth that counts as seen.
        spacing_m: mean distance between neighbouring points.
    """
    from trimesh.remesh import subdivide_to_size

    from ms_slam_env.scenes.mesh_queries import RayCaster, sample_surface

    mesh = scene.mesh
    vertices, faces = subdivide_to_size(mesh.vertices.astype(np.float64), mesh.faces, _PIECE_M, 20)
    middles = vertices[faces].mean(axis=1)
    radii = np.linalg.norm(vertices[faces] - middles[:, None], axis=2).max(axis=1)
    T_camera_world = invert(poses)
    in_view = [_in_pyramid(transform_points(T, middles), radii, intrinsics, depth_m)
               for T in T_camera_world]  # fmt: skip
    chosen = np.flatnonzero(np.any(in_view, axis=0))
    if not len(chosen):
        return np.empty((0, 3))
    points, face = sample_surface(vertices, faces[chosen], spacing_m)
    caster = RayCaster(mesh.vertices, mesh.faces)
    seen = np.zeros(len(points), dtype=bool)
    for T, eye, own in zip(T_camera_world, poses[:, :3, 3], in_view, strict=True):
        picked = np.flatnonzero(own[chosen][face] & ~seen)
        local = transform_points(T, points[picked])
        picked = picked[_in_pyramid(local, 0.0, intrinsics, depth_m)]
        ways = points[picked] - eye
        hit, _ = caster.first_hit(np.broadcast_to(eye, ways.shape), ways)  # 1 is the point itself
        seen[picked[(hit - 1) * np.linalg.norm(ways, axis=1) >= -_BEHIND_M]] = True
    return points[seen]


def _in_pyramid(
    points: Float64, radius_m: Float64 | float, intrinsics: Intrinsics, depth_m: float
) -> Bool:
    """Whether spheres about points (N, 3) of the camera's frame may reach into its view, (N,)."""
    x, y, z = points.T
    inside: Bool = (z > -radius_m) & (z <= depth_m + radius_m)
    for along, f, c, size in (
        (x, intrinsics.fx, intrinsics.cx, intrinsics.width),
        (y, intrinsics.fy, intrinsics.cy, intrinsics.height),
    ):
        for edge, sign in ((-0.5, 1.0), (size - 0.5, -1.0)):
            slope = (edge - c) / f  # of the side plane along = slope z
            inside &= sign * (along - slope * z) >= -radius_m * np.hypot(1.0, slope)
    return inside


@dataclass(frozen=True)
class SequenceWithSurface(Sequence):
    """A sequence in memory, with its ground truth.

    Attributes:
        surface: (M, 3) points of the true surface that the frames saw, about 1 cm apart, world
            frame.
    """

    surface: Float64


def open_with_surface(text: str, image_size: str, path: CameraPath) -> SequenceWithSurface:
    """Open the sequence named ``text`` at ``image_size``; rendered ones follow ``path``.

    Raises:
        InputError: a sequence that cannot be rendered or read, or a recording without truth or
            depth readings.
    """
    from ms_slam_env.sequences import open_sequence

    sequence = open_sequence(text, image_size, path=path, with_truth=True)
    surface = seen_surface(sequence)
    frames = tuple(sequence.frames)
    return SequenceWithSurface(frames, sequence.poses, sequence.intrinsics, sequence.name, surface)
