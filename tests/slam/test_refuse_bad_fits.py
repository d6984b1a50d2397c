"""What happens to frames that fit the map badly."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam as slam_backends
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam import SlamBackend


def frames_with_a_jump() -> tuple[np.ndarray, list[RGBDFrame]]:
    """The same view four times, then one from the other side of the room."""
    scene = BoxScene()
    sensor = RGBDSensor(scene, xtion("80x60"), noise="none")
    start = scene.sample_start(np.random.default_rng(0))
    back = start.copy()
    back[:3, :3] = start[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    poses = [start] * 4 + [back]
    return start, [sensor.capture(pose, index=k) for k, pose in enumerate(poses)]


def run(refuse: bool) -> tuple[list[bool], SlamBackend]:
    start, frames = frames_with_a_jump()
    slam = slam_backends.make("surfel", xtion("80x60"), refuse_bad_fits=refuse)
    slam.reset(start)
    return [slam.track(frame).tracking_ok for frame in frames], slam


def test_a_frame_from_elsewhere_is_refused_or_fused() -> None:
    ok, careful = run(refuse=True)
    assert ok == [True] * 4 + [False]
    ok, careless = run(refuse=False)
    assert ok == [True] * 5
    assert np.isfinite(careless.map_points()).all()
    assert len(careless.map_points()) > 1.1 * len(careful.map_points())


@pytest.mark.parametrize(("inliers", "fused"), [(0.65, [True] * 4), (1.0, [True] + [False] * 3)])
def test_the_share_of_inliers_that_is_demanded_is_an_option(inliers: float, fused: list) -> None:
    scene = BoxScene()
    sensor = RGBDSensor(scene, xtion("80x60"), noise="kinect")
    start = scene.sample_start(np.random.default_rng(0))
    rules = {"inliers": inliers, "doubted": {"inliers": inliers}}
    slam = slam_backends.make("surfel", xtion("80x60"), acceptance=rules)
    slam.reset(start)
    frames = [sensor.capture(start, index=k) for k in range(4)]
    assert [slam.track(frame).fused for frame in frames] == fused


def test_only_booleans_are_taken() -> None:
    with pytest.raises(InputError, match="refuse_bad_fits"):
        slam_backends.make("surfel", xtion("80x60"), refuse_bad_fits="no")
