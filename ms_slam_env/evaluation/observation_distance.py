"""Observation distance: how far the observed surface points move from one frame to the next.

Saeedi, Carvalho, Li, Tzoumanikas, Leutenegger, Kelly, Davison, "Characterizing visual localization
and mapping datasets", ICRA 2019, the successor of Table I of the ICRA 2017 paper, defines the
difficulty of a data set as the mean or median over time of

    w(t) = W_2(P_t, P_t-1),   P_t = prod_k p(z_t,k | x_t, m_k)

the 2-Wasserstein distance between the likelihoods of consecutive frames. These are Gaussian: their
means come from the true poses and landmarks, their variances from the sensor noise. We know only
the paper's abstract and summaries, and chose the rest ourselves. Landmarks are the points of the
earlier frame's depth image (a grid) that the later frame sees too. An observation is the point in
the camera frame, with the noise of a Kinect (Nguyen et al., 3DIMPVT 2012) along and across the
optical axis. P factorises over the landmarks, so the squared distances add up; we use their mean,
so that the number of landmarks does not matter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.geometry import invert, transform_points

_ACROSS = 40  # landmarks in a row of the grid
_HIDDEN = 0.05  # share of the depth by which a landmark may lie behind the later frame's surface
_LATERAL_PX = 0.8  # standard deviation across the optical axis


def observation_distance(
    before: RGBDFrame, after: RGBDFrame, T_before_after: Float64, K: Intrinsics
) -> float:
    """w(t) in metres per landmark; NaN if the frames see nothing in common.

    Args:
        before: frame t - 1.
        after: frame t.
        T_before_after: (4, 4) true motion of the camera.
        K: intrinsics of both.
    """
    step = max(1, K.width // _ACROSS)
    depth = before.depth[::step, ::step]
    seen = depth > 0
    z_before = K.rays()[::step, ::step][seen] * depth[seen][:, None]
    z_after = transform_points(invert(T_before_after), z_before)
    both = _are_seen(z_after, after, K)
    if not both.any():
        return float("nan")
    a, b = z_before[both], z_after[both]
    # For Gaussians with the same axes, W_2^2 = |mu_a - mu_b|^2 + |sigma_a - sigma_b|^2.
    moved, noisier = a - b, noise(a, K) - noise(b, K)
    return float(np.sqrt((moved**2 + noisier**2).sum(axis=1).mean()))


def noise(points: Float64, K: Intrinsics) -> Float64:
    """Standard deviations (N, 3) in metres of observed points (N, 3): across (twice) and along."""
    z = points[:, 2]
    across = _LATERAL_PX * z / K.fx
    along = 0.0012 + 0.0019 * np.maximum(z - 0.4, 0.0) ** 2
    return np.stack([across, across, along], axis=1)


def _are_seen(points: Float64, frame: RGBDFrame, K: Intrinsics) -> NDArray[np.bool_]:
    """Whether points (N, 3) in the camera frame are in the image and not occluded, (N,)."""
    z = np.where(points[:, 2] > 0, points[:, 2], np.inf)
    u = np.round(K.fx * points[:, 0] / z + K.cx)
    v = np.round(K.fy * points[:, 1] / z + K.cy)
    inside = np.isfinite(z) & (u >= 0) & (u < K.width) & (v >= 0) & (v < K.height)
    shown = np.zeros(len(points), dtype=bool)
    there = frame.depth[v[inside].astype(int), u[inside].astype(int)]
    shown[inside] = (there > 0) & (z[inside] < (1 + _HIDDEN) * there)
    return shown
