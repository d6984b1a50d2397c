"""A frame over a carpet, whose fine texture is gone at the coarser levels of the pyramid."""

from __future__ import annotations

import numpy as np
import pytest

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.sequences import HandheldPath, Sequence, open_sequence
from ms_slam_env.slam.surfel.photometry import is_leap, same_exposure

STEP = 6  # frames of 1.5 cm and 0.7 degrees that are skipped


@pytest.fixture(scope="module")
def carpet() -> Sequence:
    path = HandheldPath(240, speed_m_s=0.4, turn_deg_s=20.0)
    return open_sequence("carpet:1003", path=path).picked(STEP * np.arange(6))


def _errors(sequence: Sequence, frames: list[RGBDFrame], check_slips: bool) -> np.ndarray:
    system = slam.make("surfel", sequence.intrinsics, check_slips=check_slips)
    system.reset(sequence.poses[0])
    estimate = np.stack([system.track(frame).T_world_camera for frame in frames])
    return np.linalg.norm(estimate[:, :3, 3] - sequence.poses[:, :3, 3], axis=1)


def test_frames_that_slip_over_a_carpet_are_put_right(carpet):
    frames = list(carpet.frames)
    slipped, checked = (_errors(carpet, frames, check) for check in (False, True))
    assert slipped.max() > 0.05
    assert checked.max() < 0.005


def test_a_leap_is_a_sudden_misfit_of_grey_values_that_were_trusted():
    before, after = same_exposure(5), same_exposure(5)
    before["reference"][3], before["trust"][4] = 3.0, 0.01
    after["scale"] = [0.9, 1.0, 0.7, 1.0, 0.7]
    after["trust"][[2, 4]] = 0.0
    np.testing.assert_array_equal(is_leap(before, after, 1.0), [False, True, True, False, False])
