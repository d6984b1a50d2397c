"""Predict which motions SLAM can track, from the map's predicted views at their ends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import wp
from ms_slam_env.planning.kernels import mat66, sum_information, sum_remaining
from ms_slam_env.slam.slam_backend import Views


def view_information(views: Views) -> Float64:
    """Information matrices (N, 6, 6) of the camera's pose, translation first.

    H = sum J^T J / sigma_z^2 over the pixels of a view, with J = [n, p x n / d] of point-to-plane
    alignment at the predicted points p and normals n. d is the view's mean depth: it makes
    rotations comparable with translations, so that eigenvalues, in 1/m^2, cover both.
    sigma_z = 1.2 mm + 1.9 mm (z - 0.4 m)^2 / m^2 (Nguyen et al., 3DIMPVT 2012, the axial noise of
    a Kinect). Texture is ignored: it constrains small motions only, and on a repeating pattern a
    step of 12 cm may align with the wrong repetition.
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


def remaining(view: Views, poses: Float64) -> tuple[Float64, Float64, Float64]:
    """The part of a view that nearby poses still see, without rendering the map.

    Args:
        view: one view, from the camera's pose.
        poses: (n, 4, 4) T_here_there.

    Returns:
        `view_information` (n, 6, 6) of the pixels that remain visible, with the mean depth of the
        view itself; the share of the image that they make up (n,); and the share that they make up
        nearer than NEAR_M (n,).
    """
    k, (height, width) = view.intrinsics, view.depth.shape[1:]
    with wp.ScopedDevice("cpu"):
        sums = wp.zeros((len(poses), height), dtype=mat66)
        counts = wp.zeros((len(poses), height), dtype=wp.vec2)
        given = [
            wp.array(view.depth[0], dtype=float, copy=False),
            wp.array(view.normals[0], dtype=wp.vec3, copy=False),
            wp.array(np.linalg.inv(poses).astype(np.float32), dtype=wp.mat44),
            float(mean_depth(view)[0]),
            NEAR_M,
            wp.vec2(k.fx, k.fy),
            wp.vec2(k.cx, k.cy),
        ]
        wp.launch(sum_remaining, sums.shape, given, [sums, counts])
    shares = counts.numpy().sum(axis=1, dtype=np.float64) / (height * width)
    return sums.numpy().sum(axis=1, dtype=np.float64), shares[:, 0], shares[:, 1]


def mean_depth(views: Views) -> Float64:
    """(N,) mean depth of the pixels with map surface, at least 0.3 m."""
    shown = np.count_nonzero(views.depth, axis=(1, 2))
    return np.maximum(views.depth.sum(axis=(1, 2), dtype=np.float64) / np.maximum(shown, 1), 0.3)


SCALE = 0.25
"""Size of the views predicted, relative to the camera's image."""
NEAR_M = 0.5  # nearer than this few readings remain, and the next step may leave none
NEAR_SHARE = 0.1
_KEPT = 1.3  # times the least risk, where every motion is riskier than permitted
_SLIP = (0.85, -0.82, 1.06, -1.94)
"""Log-odds of a slip: constant, by log(l + 5 / m^2), by 10 degrees of image motion, by log(d / m).

l is the second least eigenvalue of the view's information per pixel, d the mean depth of the
current view. Logistic regression on 1700 motions of training seeds (`wall` 1131; `living_room`,
`corridor`, `table`), of which 4.9 % were lost or more than 2 cm off: 1 % of the half predicted
safest and 20 % of the eighth predicted riskiest.
"""


def image_motion(views: Views, poses: Float64) -> Float64:
    """Median angle (n,), radians, by which the points of view 0 move in the views from poses."""
    every = (slice(None, None, 4),) * 2
    rays = views.intrinsics.rays()[every].reshape(-1, 3)
    depth = views.depth[0][every].reshape(-1).astype(np.float64)
    points = (rays * depth[:, None])[depth > 0]
    if not len(points):
        return np.full(len(poses), np.pi)
    to_each = np.linalg.inv(poses) @ poses[0]
    seen = points @ to_each[:, :3, :3].transpose(0, 2, 1) + to_each[:, None, :3, 3]
    lengths = np.linalg.norm(seen, axis=-1) * np.linalg.norm(points, axis=-1)
    cosine = (seen * points).sum(axis=-1) / np.maximum(lengths, 1e-9)
    return np.median(np.arccos(np.clip(cosine, -1, 1)), axis=1)


def slip_risk(views: Views, poses: Float64, frames: int = 1) -> Float64:
    """Probability (n,) that SLAM slips on the way from view 0 to the views from poses (n, 4, 4).

    Where a surface is plain or its texture repeats, alignment may converge to a wrong pose near the
    right one. The risk grows with image motion, with nearness of the surface, and with weakness of
    the geometry in the two least constrained directions of the pose. With several ``frames`` on the
    way it is the risk of each frame, which has its share of the motion.
    """
    motion_rad = image_motion(views, poses) / frames
    return risk_of(view_information(views), views, motion_rad, mean_depth(views)[0])


def risk_of(H: Float64, views: Views, motion_rad: Float64, depth_m: Float64) -> Float64:
    """Probability (n,) of slipping on the way to views with information H (n, 6, 6).

    Args:
        H: of the views, see `view_information`.
        views: the n views.
        motion_rad: angle by which the image moves on the way.
        depth_m: mean depth of the view at the start.
    """
    weak = np.linalg.eigvalsh(H)[:, 1] / views.depth[0].size
    motion = np.degrees(motion_rad) / 10
    log_odds = _SLIP[0] + _SLIP[1] * np.log(weak + 5) + _SLIP[2] * motion
    log_odds += _SLIP[3] * np.log(depth_m)
    return np.asarray(1 / (1 + np.exp(-log_odds)))


def follow_risks(
    views: Views,
    poses: Float64,
    permitted: NDArray[np.bool_],
    overlap: float,
    frames: int = 1,
) -> Float64:
    """Slip risk (n,) of motions from view 0 to the views from poses (n, 4, 4).

    Infinite for motions that are not permitted, show too little of the map or end too near to it.

    Args:
        views: predicted from the map; the first is from the current pose.
        poses: of the views, T_world_camera.
        permitted: (n,) the motions to consider.
        overlap: share of a view that the map should fill.
        frames: number of frames taken on a motion.
    """
    shown = (views.depth > 0).mean(axis=(1, 2))
    near = ((views.depth > 0) & (views.depth < NEAR_M)).mean(axis=(1, 2))
    can = permitted & (shown >= min(overlap, shown[0])) & (near <= max(NEAR_SHARE, near[0]))
    return np.where(can, slip_risk(views, poses, frames), np.inf)


def bearable(risk: float, risks: Float64, leads_on: NDArray[np.bool_]) -> float:
    """Acceptable risk: ``risk``, or slightly more than the least if every motion is riskier.

    Args:
        risk: slip risk permitted per frame.
        risks: (n,) of the motions.
        leads_on: (n,) which motions lead to another view; a roll does not.
    """
    return max(risk, _KEPT * np.min(risks[leads_on], initial=1.0))


def leads_on(poses: Float64, here: Float64) -> NDArray[np.bool_]:
    """Which poses (n, 4, 4) differ from ``here`` (4, 4) by more than a roll."""
    return np.asarray((np.abs(poses - here)[:, :3, 2:] > 1e-6).any(axis=(1, 2)))
