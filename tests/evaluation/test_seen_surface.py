"""The true surface that a sequence saw."""

from __future__ import annotations

import inspect

import numpy as np

from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.evaluation.seen_surface import seen_surface
from ms_slam_env.sensor.noise import NoiseConfig
from ms_slam_env.sequences import Sequence
from ms_slam_env.slam.surfel import SurfelConfig


def test_the_true_surface_reaches_as_far_as_the_sensor_and_slam_looks_farther():
    reach = inspect.signature(seen_surface).parameters["cutoff_m"].default
    assert reach == NoiseConfig().max_range_m <= SurfelConfig().depth_cutoff_m


def test_seen_surface_of_a_plane() -> None:
    intrinsics = xtion("80x60")
    depth = np.full(intrinsics.shape, 2.0, dtype=np.float32)
    depth[:, :10] = 5.5  # beyond the cutoff
    depth[:10] = 0.0  # no reading
    T = np.eye(4)
    T[:3, 3] = (1.0, 2.0, 3.0)
    frame = RGBDFrame(np.zeros((*depth.shape, 3), np.uint8), depth)
    points = seen_surface(Sequence((frame,), T[None], intrinsics, "plane"))
    np.testing.assert_allclose(points[:, 2], 5.0)
    left = 1.0 + 2.0 * (10 - intrinsics.cx) / intrinsics.fx
    top = 2.0 + 2.0 * (10 - intrinsics.cy) / intrinsics.fy
    np.testing.assert_allclose(points.min(axis=0)[:2], [left, top], atol=1e-6)
