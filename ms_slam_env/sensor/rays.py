# mypy: disable-error-code="attr-defined"
# Warp's stubs do not name the fields of a ray query.
"""Kernels that generate and cast viewing rays, and the pinhole camera as a Warp struct."""

from __future__ import annotations

import numpy as np

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics


@wp.struct
class Pinhole:
    """Intrinsics for kernels, in pixels, and the number of rows that share a pose.

    With lens distortion, rays come from a table instead of focal length and centre.
    """

    fx: wp.float32
    fy: wp.float32
    cx: wp.float32
    cy: wp.float32
    width: wp.int32
    height: wp.int32
    rows: wp.int32  # rows that share a pose; ``height`` unless the shutter rolls
    bent: wp.array[wp.vec2]  # (H * W,) x and y at z = 1; empty without distortion


@wp.struct
class Hits:
    """First hit of each of N rays, overwritten by the next cast."""

    t: wp.array[wp.float32]  # (N,) ray parameter: the depth; undefined where face is -1
    u: wp.array[wp.float32]  # (N,) barycentric weight of the face's second corner
    v: wp.array[wp.float32]  # (N,) barycentric weight of its third corner
    face: wp.array[wp.int32]  # (N,) index of the face; -1 if the ray hits nothing


def make_hits(count: int, device: str) -> Hits:
    """Allocate hits for ``count`` rays."""
    hits = Hits()
    hits.t, hits.u, hits.v = (wp.zeros(count, dtype=wp.float32, device=device) for _ in range(3))
    hits.face = wp.zeros(count, dtype=wp.int32, device=device)
    return hits


def make_pinhole(intrinsics: Intrinsics, rows: int | None = None, device: str = "cpu") -> Pinhole:
    """Copy intrinsics into the struct; each ``rows`` rows share a pose, by default all rows.

    Raises:
        InputError: some pixel has no ray in front of the camera under this distortion.
    """
    pinhole = Pinhole()
    pinhole.fx, pinhole.fy = intrinsics.fx, intrinsics.fy
    pinhole.cx, pinhole.cy = intrinsics.cx, intrinsics.cy
    pinhole.width, pinhole.height = intrinsics.width, intrinsics.height
    pinhole.rows = intrinsics.height if rows is None else rows
    bent = intrinsics.rays()[..., :2].reshape(-1, 2) if intrinsics.distortion else np.zeros((0, 2))
    pinhole.bent = wp.array(bent.astype(np.float32), dtype=wp.vec2, device=device)
    return pinhole


@wp.func
def pose_of_row(camera: Pinhole, b: int, y: int) -> int:
    """Index of the pose of row ``y`` of image ``b``."""
    return b * ((camera.height + camera.rows - 1) // camera.rows) + y // camera.rows


@wp.func
def rotate(T: wp.mat44, d: wp.vec3) -> wp.vec3:
    """Rotate a direction by the rotation part of a pose."""
    return wp.vec3(
        T[0, 0] * d[0] + T[0, 1] * d[1] + T[0, 2] * d[2],
        T[1, 0] * d[0] + T[1, 1] * d[1] + T[1, 2] * d[2],
        T[2, 0] * d[0] + T[2, 1] * d[1] + T[2, 2] * d[2],
    )


@wp.func
def world_ray(T: wp.mat44, camera: Pinhole, x: int, y: int) -> wp.vec3:
    """World direction of a pixel's ray, scaled to one metre of depth."""
    if camera.bent.shape[0] > 0:
        ray = camera.bent[y * camera.width + x]
        return rotate(T, wp.vec3(ray[0], ray[1], 1.0))
    u = (float(x) - camera.cx) / camera.fx
    return rotate(T, wp.vec3(u, (float(y) - camera.cy) / camera.fy, 1.0))


@wp.func
def camera_centre(T: wp.mat44) -> wp.vec3:
    """Position of the camera in the world."""
    return wp.vec3(T[0, 3], T[1, 3], T[2, 3])


@wp.kernel
def generate_rays(
    T_world_camera: wp.array[wp.mat44],  # (B * poses an image,)
    camera: Pinhole,
    origins: wp.array[wp.vec3],  # (B * H * W,)
    directions: wp.array[wp.vec3],  # (B * H * W,)
) -> None:
    """Generate one ray per pixel."""
    b, y, x = wp.tid()
    T = T_world_camera[pose_of_row(camera, b, y)]
    i = (b * camera.height + y) * camera.width + x
    origins[i] = camera_centre(T)
    directions[i] = world_ray(T, camera, x, y)


@wp.func
def cast_ray(
    mesh: wp.uint64, T: wp.mat44, camera: Pinhole, b: int, y: int, x: int, hits: Hits
) -> None:
    """Find the first hit of a pixel's ray; face -1 if there is none."""
    i = (b * camera.height + y) * camera.width + x
    ray = world_ray(T, camera, x, y)
    query = wp.mesh_query_ray(mesh, camera_centre(T), ray, 1.0e6)
    if query.result:
        hits.t[i] = query.t
        # Warp's u and v weigh the first and second corner
        hits.u[i] = query.v
        hits.v[i] = 1.0 - query.u - query.v
        hits.face[i] = query.face
    else:
        hits.face[i] = -1


@wp.kernel
def cast_rays(
    mesh: wp.uint64,
    T_world_camera: wp.array[wp.mat44],  # (B * poses an image,)
    camera: Pinhole,
    hits: Hits,  # of B * H * W rays
) -> None:
    """Find the first hit of each pixel's ray; face -1 if there is none."""
    b, y, x = wp.tid()
    cast_ray(mesh, T_world_camera[pose_of_row(camera, b, y)], camera, b, y, x, hits)


@wp.kernel
def keep_nearer(
    camera: Pinhole,
    found: Hits,  # of H * W rays, on the body
    first_face: int,
    faces_a_pose: int,
    hits: Hits,  # of H * W rays
    posed_face: wp.array[wp.int32],
) -> None:
    """Replace hits by those on a body where the body is nearer."""
    _, y, x = wp.tid()
    i = y * camera.width + x
    hit = found.face[i]
    if hit >= 0 and (hits.face[i] < 0 or found.t[i] < hits.t[i]):
        hits.t[i] = found.t[i]
        hits.u[i] = found.u[i]
        hits.v[i] = found.v[i]
        hits.face[i] = first_face + hit
        posed_face[i] = first_face + pose_of_row(camera, 0, y) * faces_a_pose + hit
