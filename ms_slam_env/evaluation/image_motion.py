"""How the image moves from one frame to the next: what makes a motion hard, besides the scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.evaluation.sequence_divergence import consecutive_divergences
from ms_slam_env.geometry import invert, relative_angle, transform_points
from ms_slam_env.sequences import Sequence

MOTIONS = ("turn_deg_s", "speed_m_s", "image_motion_deg_s")
"""Columns of `frame_motion`."""

_PIXELS_ACROSS = 40  # of the grid of points that are followed


@dataclass(frozen=True)
class WatchedSequence:
    """How T + 1 frames follow each other.

    Attributes:
        times_s: (T,) of the later frame of each pair, since the first.
        gaps_s: (T,) between the frames of each pair.
        divergences: by name of the histograms, (T, 2) intensity and depth, nats.
        motion: by ``MOTIONS``, (T,).
        contrast: mean over the frames of the grey values' standard deviation.
        depth_m: mean over the frames of their mean depth.
    """

    times_s: Float64
    gaps_s: Float64
    divergences: dict[str, Float64]
    motion: dict[str, Float64]
    contrast: float
    depth_m: float


def watch_frames(sequence: Sequence, histograms: Mapping[str, DivergenceConfig]) -> WatchedSequence:
    """Measure each frame against the one before, once through; without colour intensity is NaN.

    Args:
        sequence: with true poses.
        histograms: settings of the divergence by name.
    """
    times, poses, K = sequence.timestamps, sequence.poses, sequence.intrinsics
    motion, shades, depths = [], [], []

    def seen() -> Iterator[RGBDFrame]:
        for index, frame in enumerate(sequence.frames):
            shades.append(contrast(frame))
            depths.append(float(frame.depth[frame.depth > 0].mean()) if frame.depth.any() else 0.0)
            if index + 1 < len(poses):
                gap_s = float(times[index + 1] - times[index])
                motion.append(frame_motion(frame, poses[index], poses[index + 1], K, gap_s))
            yield frame

    values = consecutive_divergences(seen(), K, list(histograms.values()))
    if not sequence.has_color:
        values[..., 0] = np.nan
    return WatchedSequence(
        times[1:] - times[0],
        np.diff(times),
        {name: values[:, k] for k, name in enumerate(histograms)},
        dict(zip(MOTIONS, np.array(motion).T, strict=True)),
        float(np.mean(shades)),
        float(np.mean(depths)),
    )


def by_second(
    times_s: Float64, values: Float64, gaps_s: Float64
) -> tuple[list[float], list[float]]:
    """Middles of the seconds, and the rates in them: sum of the values by that of the gaps.

    Args:
        times_s: (T,) since the first frame.
        values: (T,) between two frames.
        gaps_s: (T,) between the two frames.
    """
    second = times_s.astype(int)
    filled = np.bincount(second) > 0
    rates = np.bincount(second, values)[filled] / np.bincount(second, gaps_s)[filled]
    return (np.flatnonzero(filled) + 0.5).tolist(), rates.tolist()


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
