"""Frame by frame: how long a lost camera is sought."""

from __future__ import annotations

import numpy as np
import pytest
from surfel_scenes import ray_cast

from ms_slam_env import slam
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.slam.odometry.odometry import odometry
from ms_slam_env.slam.shared.tracking_template import SEARCHED_FRAMES

CAMERA = Intrinsics(fx=60.0, fy=60.0, cx=39.5, cy=29.5, width=80, height=60)


def _frame(pose: np.ndarray) -> RGBDFrame:
    depth, _, color = ray_cast(pose, CAMERA)
    return RGBDFrame(np.rint(color).astype(np.uint8), depth.astype(np.float32))


def test_a_camera_that_is_lost_for_long_is_sought_in_every_tenth_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched: list[int] = []
    lost: list[bool] = []
    search = odometry.motion_hypotheses

    def counted(*args: object) -> object:
        searched.append(len(lost))
        return search(*args)

    monkeypatch.setattr(odometry, "motion_hypotheses", counted)
    backend = slam.make("odometry", CAMERA)
    home = _frame(np.eye(4))
    assert backend.track(home).tracking_ok
    noise = np.random.default_rng(0)
    elsewhere = RGBDFrame(
        noise.integers(0, 255, (60, 80, 3), dtype=np.uint8),
        noise.uniform(0.5, 3.5, (60, 80)).astype(np.float32),
    )
    for _ in range(SEARCHED_FRAMES + 25):
        lost.append(not backend.track(elsewhere).tracking_ok)
    assert all(lost)
    assert searched == [*range(SEARCHED_FRAMES + 1), SEARCHED_FRAMES + 10, SEARCHED_FRAMES + 20]
    moved = make_pose(so3_exp([0.0, np.radians(9.0), 0.0]), [0.08, 0.0, 0.0])
    found = [backend.track(_frame(moved)) for _ in range(10)]
    assert any(result.relocalised for result in found)
    searched.clear()
    backend.track(elsewhere)
    assert len(searched) == 1  # the count begins anew
