"""Kernel that lets the hits on a moving body take the place of those behind them."""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.sensor.rays import Pinhole, pose_of_row


@wp.kernel
def keep_nearer(
    camera: Pinhole,
    part_t: wp.array(dtype=wp.float32),  # (H * W,)
    part_u: wp.array(dtype=wp.float32),
    part_v: wp.array(dtype=wp.float32),
    part_face: wp.array(dtype=wp.int32),
    first_face: int,
    faces_a_pose: int,
    t: wp.array(dtype=wp.float32),  # (H * W,)
    u: wp.array(dtype=wp.float32),
    v: wp.array(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
    posed_face: wp.array(dtype=wp.int32),
):
    """Where a body is hit before anything else, its hit takes the place of the other."""
    _, y, x = wp.tid()
    i = y * camera.width + x
    hit = part_face[i]
    if hit >= 0 and (face[i] < 0 or part_t[i] < t[i]):
        t[i] = part_t[i]
        u[i] = part_u[i]
        v[i] = part_v[i]
        face[i] = first_face + hit
        posed_face[i] = first_face + pose_of_row(camera, 0, y) * faces_a_pose + hit
