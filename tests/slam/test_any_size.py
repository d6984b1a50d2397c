"""SLAM, sensor, divergence and prediction at sizes that nobody chose.

Run in a checked build too (``make test``): there an index outside an array ends the process.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arc import arc
from box_scene import BoxScene
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ms_slam_env import slam
from ms_slam_env.camera import Distortion, Intrinsics, RGBDFrame
from ms_slam_env.camera.undistortion import undistort_depth
from ms_slam_env.divergence import depth_divergence, intensity_divergence
from ms_slam_env.errors import InputError
from ms_slam_env.sensor import RGBDSensor

ITERATIONS = {1: (10,), 2: (5, 10), 3: (4, 5, 10), 4: (4, 5, 5, 10)}
POSES = arc(6)
FAR_M = 2.5  # of most of what the arc shows

SMALLEST = 32  # pixels of a side, from which on tracking is promised
sides = st.integers(8, 170)


def camera(width: int, height: int) -> Intrinsics:
    """A camera of about 58 degrees over its longer side."""
    focal = 0.9 * max(width, height)
    return Intrinsics(focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), width, height)


def track(backend: slam.SlamBackend, frames: list[RGBDFrame]) -> tuple[np.ndarray, int]:
    """Poses (N, 4, 4), and how many frames were lost."""
    backend.reset(POSES[0])
    results = [backend.track(frame) for frame in frames]
    return np.stack([r.T_world_camera for r in results]), sum(not r.tracking_ok for r in results)


@settings(max_examples=25)
@given(width=sides, height=sides, levels=st.integers(1, 4), points=st.sampled_from([400, 5000]))
@example(width=100, height=75, levels=3, points=5000)
@example(width=40, height=30, levels=3, points=5000)
@example(width=155, height=47, levels=4, points=400)
def test_runs_are_equal_and_the_error_in_proportion(
    box_scene: BoxScene, width, height, levels, points
):
    K = camera(width, height)
    if min(width, height) >> (levels - 1) < 2:
        with pytest.raises(InputError, match=f"{width}x{height} are too small for a pyramid"):
            slam.make("surfel", K, iterations=ITERATIONS[levels])
        return
    sensor = RGBDSensor(box_scene, K, noise="kinect", seed=0)
    frames = [sensor.capture(pose, index) for index, pose in enumerate(POSES)]
    again = RGBDSensor(box_scene, K, noise="kinect", seed=0)
    for index, frame in enumerate(frames):
        other = again.capture(POSES[index], index)
        np.testing.assert_array_equal(other.depth, frame.depth)
        np.testing.assert_array_equal(other.color, frame.color)
    options = {"iterations": ITERATIONS[levels], "points_per_level": points}
    first, lost = track(slam.make("surfel", K, **options), frames)
    second, _ = track(slam.make("surfel", K, **options), frames)
    np.testing.assert_array_equal(first, second)
    if min(width, height) < SMALLEST:
        return
    assert lost == 0
    error = np.linalg.norm(first[:, :3, 3] - POSES[:, :3, 3], axis=1)
    assert error.max() < FAR_M / K.fx  # what a pixel covers


@settings(max_examples=10)
@given(
    width=st.integers(20, 170), height=st.integers(20, 170), scale=st.sampled_from([0.3, 0.5, 1.0])
)
def test_views_and_divergences(box_scene: BoxScene, width: int, height: int, scale: float) -> None:
    K = camera(width, height)
    sensor = RGBDSensor(box_scene, K, noise="kinect", seed=0)
    frames = [sensor.capture(pose, index) for index, pose in enumerate(POSES[:2])]
    backend = slam.make("surfel", K)
    track(backend, frames)
    views, others = (backend.predict(POSES, scale) for _ in range(2))
    assert views.depth.shape[1:] == K.scaled(scale).shape
    np.testing.assert_array_equal(views.depth, others.depth)
    assert (views.depth > 0).mean() > 0.3
    for value in (
        intensity_divergence(frames[1].color, frames[0].color),
        depth_divergence(frames[1].depth, frames[0].depth, K),
    ):
        assert 0 <= value < 10


@settings(max_examples=8)
@given(width=st.integers(20, 170), height=st.integers(20, 170), k1=st.floats(-0.2, 0.1))
def test_a_lens_that_is_straightened(
    box_scene: BoxScene, width: int, height: int, k1: float
) -> None:
    K = replace(camera(width, height), distortion=Distortion.of("radtan", [k1, 0.0, 0.0, 0.0]))
    sensor = RGBDSensor(box_scene, K, noise="none")
    straight = undistort_depth(sensor.capture(POSES[0], 0).depth, K)
    plain = RGBDSensor(box_scene, K.undistorted, noise="none").capture(POSES[0], 0).depth
    both = (straight > 0) & (plain > 0)
    assert both.mean() > 0.5
    assert np.median(np.abs(straight - plain)[both]) < FAR_M / K.fx


@pytest.mark.parametrize("size", [(93, 71), (101, 54)])
@pytest.mark.parametrize(
    "options",
    [
        {"motion_mask": "geometric"},
        {"loop_closure": "deformation", "submaps": "atlas"},
        {"readout_s": 0.03},
        {"color_registration": "estimated"},
        {"check_slips": True, "refuse_open": True, "points_per_level": 800},
    ],
    ids=lambda options: next(iter(options)),
)
def test_what_can_be_switched_on(box_scene: BoxScene, size, options) -> None:
    K = camera(*size)
    sensor = RGBDSensor(box_scene, K, noise="kinect", seed=0)
    frames = [sensor.capture(pose, index, index / 30) for index, pose in enumerate(POSES)]
    first, second = (slam.make("surfel", K, **options) for _ in range(2))
    poses, lost = track(first, frames)
    assert lost == 0
    np.testing.assert_array_equal(track(second, frames)[0], poses)
    first.mark_lost()
    assert np.isfinite(first.track(frames[0]).T_world_camera).all()


@pytest.mark.parametrize("name", ["odometry", "kinectfusion", "sparse", "volumetric"])
def test_other_backends_repeat_at_odd_sizes(box_scene: BoxScene, name: str) -> None:
    if name == "sparse":
        pytest.importorskip("gtsam")
    if name == "volumetric":
        pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)
    for size in ((131, 97), (93, 71)):
        K = camera(*size)
        sensor = RGBDSensor(box_scene, K, noise="kinect", seed=0)
        frames = [sensor.capture(pose, index) for index, pose in enumerate(POSES)]
        poses, _ = track(slam.make(name, K), frames)
        np.testing.assert_array_equal(track(slam.make(name, K), frames)[0], poses)
