"""How the image moves from one frame to the next: what makes a motion hard, besides the scene."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.geometry import invert, relative_angle, transform_points

Float64 = NDArray[np.float64]

MOTIONS = ("turn_deg_s", "speed_m_s", "image_motion_deg_s")
"""Columns of `frame_motion`."""

_PIXELS_ACROSS = 40  # of the grid of points that are followed


def frame_motion(
    frame: RGBDFrame, T_world_camera: Float64, T_world_next: Float64, K: Intrinsics, gap_s: float
) -> Float64:
    """How fast the camera and its image move from a frame to the next, (3,) as in ``MOTIONS``.

    ``turn_deg_s`` and ``speed_m_s`` are the camera's; ``image_motion_deg_s`` is the mean angle by
    which the surface points of the frame move in the camera's view, which depends on how far away
    they are; without a depth reading it is NaN.

    Args:
        frame: with depth.
        T_world_camera: (4, 4) its pose.
        T_world_next: (4, 4) pose of the next frame.
        K: intrinsics of the frame.
        gap_s: seconds between the two.
    """
    T_next_camera = invert(T_world_next) @ T_world_camera
    turn_deg = np.degrees(relative_angle(np.eye(3), T_next_camera[:3, :3]))
    distance_m = np.linalg.norm(T_world_next[:3, 3] - T_world_camera[:3, 3])
    moved_deg = np.nan
    step = max(1, K.width // _PIXELS_ACROSS)
    depth = frame.depth[::step, ::step]
    rays = _rays(K, step)[depth > 0]
    if len(rays):
        points = transform_points(T_next_camera, rays * depth[depth > 0][:, None])
        moved_deg = np.degrees(_angles(rays, points).mean())
    return np.array([turn_deg, distance_m, moved_deg]) / gap_s


def contrast(frame: RGBDFrame) -> float:
    """Standard deviation of the frame's grey values, in grey levels."""
    return float(intensity_image(frame.color).std())


@lru_cache(maxsize=4)
def _rays(K: Intrinsics, step: int) -> Float64:
    return K.rays()[::step, ::step].copy()


def _angles(a: Float64, b: Float64) -> Float64:
    """Angles (N,) in radians between directions (N, 3)."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
