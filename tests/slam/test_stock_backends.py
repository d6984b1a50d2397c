"""OpenCV's odometry and Open3D's dense SLAM as they are: option ``stock``."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.sequences import Sequence, handheld_trajectory, render_sequence

CAMERA = xtion("160x120")
BLACK = RGBDFrame(
    np.zeros((*CAMERA.shape, 3), dtype=np.uint8), np.zeros(CAMERA.shape, dtype=np.float32)
)


@pytest.fixture(scope="module")
def sequence(box_scene: BoxScene) -> Sequence:
    poses = handheld_trajectory(box_scene, 12, seed=0)
    return render_sequence(box_scene, poses, CAMERA, noise="none")


def _make(name: str, sequence: Sequence) -> slam.SlamBackend:
    if name == "volumetric":
        pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)
    backend = slam.make(name, CAMERA, stock=True)
    backend.reset(sequence.poses[0])
    return backend


@pytest.mark.parametrize(("name", "limit_m"), [("odometry", 0.005), ("volumetric", 0.03)])
def test_a_clean_sequence_is_tracked(name: str, limit_m: float, sequence: Sequence) -> None:
    backend = _make(name, sequence)
    results = [backend.track(frame) for frame in sequence.frames]
    assert all(result.tracking_ok for result in results)
    estimates = [result.T_world_camera for result in results]
    assert ate_rmse(estimates, sequence.poses, align="none") < limit_m
    assert len(backend.surface_points()) > 1000


def test_any_motion_that_is_found_is_believed(sequence: Sequence) -> None:
    """A frame upside down in brightness fits nothing, and only the checks can tell."""
    frame = sequence.frames[1]
    negative = RGBDFrame(255 - frame.color, frame.depth)
    results = {}
    for stock in (False, True):
        backend = slam.make("odometry", CAMERA, stock=stock)
        backend.reset(sequence.poses[0])
        backend.track(sequence.frames[0])
        results[stock] = backend.track(negative)
    assert "intensity" in results[False].reason
    assert results[True].tracking_ok


def test_a_frame_that_cannot_be_aligned_becomes_the_keyframe(sequence: Sequence) -> None:
    backend = _make("odometry", sequence)
    held = backend.track(sequence.frames[0]).T_world_camera
    for frame in (BLACK, sequence.frames[4]):  # nothing aligns with a black keyframe
        result = backend.track(frame)
        assert not result.tracking_ok
        np.testing.assert_array_equal(result.T_world_camera, held)
    assert backend.track(sequence.frames[5]).relocalised


@pytest.mark.parametrize("name", ["odometry", "volumetric"])
def test_stock_is_a_yes_or_no(name: str) -> None:
    with pytest.raises(InputError, match="stock = 'yes' must be true or false"):
        slam.check_parameters(name, {"stock": "yes"})
