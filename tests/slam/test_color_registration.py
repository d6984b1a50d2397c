"""The offset of the colour camera, from the edges of the first frames, against the true one."""

from __future__ import annotations

import numpy as np
import pytest

from ms_slam_env import slam
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.sequences import HandheldPath, Sequence, open_sequence
from ms_slam_env.slam.surfel import color_cameras
from ms_slam_env.slam.surfel.color_cameras import depth_edges, estimate_camera_offset

PATH = HandheldPath(40)
FOCAL_RATIO, BASELINE_M = 525 / 585, 0.025  # of the perturbation


def _sequence(*perturbations: str) -> Sequence:
    whole = open_sequence("+".join(["living_room:1001:kinect", *perturbations]), path=PATH)
    return whole.picked(np.arange(PATH.frames))


@pytest.fixture(scope="module")
def apart() -> Sequence:
    return _sequence("misregistration")


@pytest.fixture(scope="module")
def together() -> Sequence:
    return _sequence()


def _edges(sequence: Sequence) -> list[np.ndarray]:
    return [depth_edges(frame.depth, sequence.intrinsics) for frame in sequence.frames]


def test_edges_are_where_depth_steps_on_the_near_side(apart):
    K = apart.intrinsics
    depth = np.full(K.shape, 2.0, dtype=np.float32)
    depth[40:60, 50:80] = 1.0
    x, y, z = depth_edges(depth, K).T
    assert len(z) == 2 * (20 + 30)
    np.testing.assert_array_equal(z, 1.0)
    u, v = K.fx * x / z + K.cx, K.fy * y / z + K.cy
    across, along = np.isin(u.round(6), (49.5, 79.5)), np.isin(v.round(6), (39.5, 59.5))
    assert (across ^ along).all()


def test_the_offset_is_found_and_none_where_there_is_none(apart, together):
    colors = [frame.color for frame in apart.frames]
    found = estimate_camera_offset(colors, _edges(apart), apart.intrinsics)
    assert found is not None
    assert found.focal_ratio == pytest.approx(FOCAL_RATIO, abs=0.012)
    assert found.baseline_m == pytest.approx(BASELINE_M, abs=0.005)
    colors = [frame.color for frame in together.frames]
    assert estimate_camera_offset(colors, _edges(together), together.intrinsics) is None
    few = [points[:1] for points in _edges(apart)]
    assert estimate_camera_offset(colors, few, apart.intrinsics) is None


def _run(sequence: Sequence, variant: str) -> tuple[slam.SlamBackend, np.ndarray]:
    system = slam.make("surfel", sequence.intrinsics, color_registration=variant)
    system.reset(sequence.poses[0])
    return system, np.stack([system.track(frame).T_world_camera for frame in sequence.frames])


def test_what_was_mapped_before_is_mapped_anew(apart, together, monkeypatch):
    monkeypatch.setattr(color_cameras, "MOST_FRAMES", 30)
    errors = {}
    for variant in ("given", "estimated"):
        system, estimates = _run(apart, variant)
        assert system.frames_counted == PATH.frames
        errors[variant] = ate_rmse(estimates[-10:], apart.poses[-10:], align="none")
    assert errors["estimated"] < 0.7 * errors["given"]
    given, estimated = (_run(together, variant)[1] for variant in ("given", "estimated"))
    np.testing.assert_array_equal(given, estimated)


def test_a_state_goes_on_bit_exactly_before_and_after_the_offset_is_known(apart, monkeypatch):
    monkeypatch.setattr(color_cameras, "MOST_FRAMES", 12)
    frames = list(apart.frames)[:18]
    one, other = (
        slam.make("surfel", apart.intrinsics, color_registration="estimated") for _ in range(2)
    )
    one.reset(apart.poses[0])
    for frame in frames[:8]:
        one.track(frame)
    other.set_state(one.get_state())
    for index, frame in enumerate(frames[8:]):
        poses = [system.track(frame).T_world_camera for system in (one, other)]
        np.testing.assert_array_equal(*poses)
        if index == 6:
            other.set_state(one.get_state())
    np.testing.assert_array_equal(one.surface_colors(), other.surface_colors())
