"""How well a predicted view would tell SLAM its pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.mapping.kernels import mat66, sum_information
from ms_slam_env.slam.base import Views

Float64 = NDArray[np.float64]


def view_information(views: Views) -> Float64:
    """Information matrices (N, 6, 6) of the camera's pose, translation first.

    H = sum J^T J / sigma_z^2 over the pixels of a view, with J = [n, p x n / d] of point-to-plane
    alignment at the predicted points p and normals n. d is the view's mean depth: it makes
    rotations comparable with translations, so that one eigenvalue, in 1/m^2, speaks of both.
    sigma_z = 1.2 mm + 1.9 mm (z - 0.4 m)^2 / m^2 (Nguyen et al., 3DIMPVT 2012, the axial noise of
    a Kinect). Texture is left out: it tells small motions only, and over a pattern that repeats a
    step of 12 cm may end on the wrong repetition.
    """
    k = views.intrinsics
    with wp.ScopedDevice("cpu"):
        sums = wp.zeros(views.depth.shape[:2], dtype=mat66)
        given = [
            wp.array(views.depth, dtype=float, copy=False),
            wp.array(views.normals, dtype=wp.vec3, copy=False),
            wp.array(mean_depth(views).astype(np.float32)),
            wp.vec2(k.fx, k.fy),
            wp.vec2(k.cx, k.cy),
        ]
        wp.launch(sum_information, sums.shape, given, [sums])
    return sums.numpy().sum(axis=1, dtype=np.float64)


def mean_depth(views: Views) -> Float64:
    """(N,) mean depth of the pixels that show map, at least 0.3 m."""
    shown = np.count_nonzero(views.depth, axis=(1, 2))
    return np.maximum(views.depth.sum(axis=(1, 2), dtype=np.float64) / np.maximum(shown, 1), 0.3)
