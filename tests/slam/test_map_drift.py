"""The drift of a map: what frames map inherits their errors, and poses in the world admit it."""

from __future__ import annotations

import numpy as np
import pytest

from ms_slam_env import slam
from ms_slam_env.camera import xtion
from ms_slam_env.geometry import adjoint, invert, se3_exp
from ms_slam_env.metrics import covariance_coverage, nees, pose_twists
from ms_slam_env.sequences import open_sequence
from ms_slam_env.slam.shared.alignment_check import (
    AcceptanceThresholds,
    DeviceStatistics,
    TrackingStatus,
)
from ms_slam_env.slam.surfel.acceptance import (
    NOISE_POWER,
    REPLACED_PX,
    USUAL,
    Alignment,
    covariance_at_noise,
    follow_drift,
)
from ms_slam_env.slam.surfel.localization import CameraStates

CAMERA = xtion("80x60")
OPTIONS = {"max_surfels": 60_000}


@pytest.fixture(scope="module")
def sequences():
    """Hand-held walks through three rooms."""
    rooms = [f"{name}:2003:kinect+handheld,frames=60" for name in ("living_room", "table", "wall")]
    return [open_sequence(room, "80x60") for room in rooms]


def _run(sequence):
    backend = slam.make("surfel", sequence.intrinsics, **OPTIONS)
    backend.reset(sequence.start)
    return [backend.track(frame) for frame in sequence.frames]


@pytest.fixture(scope="module")
def runs(sequences):
    return [_run(sequence) for sequence in sequences]


def test_poses_in_the_world_err_by_covariance_and_drift(sequences, runs) -> None:
    alone, in_world = [], []
    for sequence, results in zip(sequences, runs, strict=True):
        assert all(result.fused for result in results)
        poses = np.array([result.T_world_camera for result in results[1:]])
        errors = pose_twists(poses, sequence.poses[1:])
        C, drift = (
            np.array([getattr(result, name) for result in results[1:]])
            for name in ("covariance", "drift")
        )
        alone.append(covariance_coverage(nees(errors, C))["within_90"])
        in_world.append(covariance_coverage(nees(errors, C + drift))["within_90"])
    assert np.mean(alone) < 0.3
    assert np.mean(in_world) > 0.7


def test_the_drift_is_that_of_a_plain_loop_over_the_results(runs) -> None:
    results = runs[0]
    assert results[0].drift is None  # the first pose is given
    drift, before = np.zeros((6, 6)), results[0]
    for k, result in enumerate(results[1:], start=1):
        carry = adjoint(invert(result.T_world_camera) @ before.T_world_camera)
        drift = result.covariance if k == 1 else carry @ drift @ carry.T
        np.testing.assert_allclose(result.drift, drift, rtol=1e-7, atol=1e-15)
        if k > 1:
            share = (1 - result.overlap) * (REPLACED_PX / CAMERA.fx) ** 2
            drift = drift + min(share, 1.0) * result.covariance
        before = result


def _alignment(rng: np.random.Generator, status: list[TrackingStatus]) -> Alignment:
    batch = len(status)
    motions = np.stack([se3_exp(rng.normal(0, 0.1, 6)) for _ in status])
    roots = rng.normal(size=(batch, 6, 6))
    statistics = np.zeros(batch, dtype=DeviceStatistics.numpy_dtype())
    statistics["overlap"] = rng.uniform(0.9, 1.0, batch)
    statuses = np.array(status, dtype=np.int32)
    covariance = roots @ np.swapaxes(roots, 1, 2)
    demanded = AcceptanceThresholds().repeated(batch)
    found = motions, motions, statuses, statistics, np.zeros(batch), covariance
    return Alignment(*found, demanded)


def test_each_env_drifts_as_it_would_alone_and_only_by_what_it_maps() -> None:
    rng = np.random.default_rng(0)
    status = [TrackingStatus.OK, TrackingStatus.UNCERTAIN, TrackingStatus.FEW_POINTS] * 2
    found = _alignment(rng, status)
    found.T_model_live[2] = found.covariance[2] = np.nan
    drift = np.tile(np.diag(np.arange(1.0, 7.0)), (6, 1, 1))
    drift[3:] = 0  # maps of one frame
    moved = np.array([True, True, False] * 2)
    here, after = follow_drift(drift, found, moved, 100.0)
    for env in range(6):
        own = Alignment(*(array[env : env + 1] for array in vars(found).values()))
        alone = follow_drift(drift[env : env + 1], own, moved[env : env + 1], 100.0)
        np.testing.assert_array_equal(here[env], alone[0][0])
        np.testing.assert_array_equal(after[env], alone[1][0])
    carry = adjoint(invert(found.T_model_live))
    np.testing.assert_allclose(here[0], carry[0] @ drift[0] @ carry[0].T)
    assert np.trace(after[0] - here[0]) > 0.1 * np.trace(found.covariance[0])
    np.testing.assert_array_equal(after[1], here[1])  # doubted: not mapped
    np.testing.assert_array_equal(here[3], found.covariance[3])
    np.testing.assert_array_equal(after[3], here[3])
    for env in (2, 5):  # not tracked
        np.testing.assert_array_equal(after[env], drift[env])


def test_covariances_grow_with_the_noise_of_a_recording_but_do_not_shrink() -> None:
    found = _alignment(np.random.default_rng(1), [TrackingStatus.OK] * 3)
    usual = np.ones(3, dtype=USUAL)
    usual["cost"] = 0.8, 1.05, 2.1
    scaled = covariance_at_noise(found, usual).covariance
    np.testing.assert_allclose(scaled[:2], found.covariance[:2])
    np.testing.assert_allclose(scaled[2], 2.0**NOISE_POWER * found.covariance[2])
    assert covariance_at_noise(found, usual[:2]) is found


def test_known_poses_end_drift_and_a_new_submap_keeps_it(sequences) -> None:
    sequence = sequences[0]
    backend = slam.make("surfel", CAMERA, **OPTIONS)
    backend.reset(sequence.start)
    for frame in sequence.frames[:6]:
        result = backend.track(frame)
    backend.fuse(sequence.frames[6], sequence.poses[6])
    after = backend.track(sequence.frames[7])
    np.testing.assert_array_equal(after.drift, after.covariance)
    assert np.trace(after.drift) < np.trace(result.drift)

    states, T_old_new = CameraStates(1), se3_exp(np.full(6, 0.1))
    states.expect_drift(0, T_old_new, result.drift)
    carry = adjoint(invert(T_old_new))
    np.testing.assert_allclose(states.drift[0], carry @ result.drift @ carry.T)
    states.reset(0, np.eye(4))
    assert not states.drift.any()
