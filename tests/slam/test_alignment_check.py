"""Whether an alignment is believed, against closed-form views of a plane."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from surfel_scenes import ray_cast

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, make_pose, relative_angle, so3_exp
from ms_slam_env.slam.shared.alignment_check import (
    VIEW_THRESHOLDS,
    AcceptanceThresholds,
    AlignmentStatistics,
    DeviceStatistics,
    DeviceThresholds,
    TrackingStatus,
    evaluate_alignment,
    evaluate_on_device,
    failed_demand,
    status_on_appeal,
)
from ms_slam_env.slam.shared.alignment_measures import DepthImage, measure_alignment, overlay
from ms_slam_env.slam.shared.tracking_template import MOTIONS, motion_hypotheses

CAMERA = Intrinsics(fx=80.0, fy=84.0, cx=39.3, cy=29.8, width=80, height=60)
REST = np.eye(4)
MOVED = make_pose(so3_exp([0.01, 0.03, -0.02]), [0.04, -0.02, 0.03])


def _view(T_world_camera: np.ndarray) -> DepthImage:
    """A tilted textured wall."""
    depth, _, color = ray_cast(T_world_camera, CAMERA, box=False)
    return DepthImage(depth.astype(np.float32), color.mean(-1).astype(np.float32))


def test_the_true_motion_explains_everything_that_is_in_view():
    found = measure_alignment(_view(MOVED), _view(REST), MOVED, CAMERA)
    assert found.overlap > 0.85
    assert found.inlier_ratio == 1
    assert found.photometric_inlier_ratio == 1
    assert found.residual_m < 1e-6  # the planes through neighbouring pixels are the wall
    assert evaluate_alignment(found, VIEW_THRESHOLDS) == TrackingStatus.OK


@given(offset_m=st.floats(0.0, 0.05))
def test_the_residual_is_the_distance_to_the_plane(offset_m):
    depth = np.full(CAMERA.shape, 2.0, dtype=np.float32)
    wall = DepthImage(depth, np.zeros_like(depth))
    moved = make_pose(np.eye(3), [0.0, 0.0, offset_m])
    found = measure_alignment(wall, wall, moved, CAMERA)
    assert found.inlier_ratio == 1
    assert found.residual_m == pytest.approx(offset_m, abs=1e-6)


def test_a_darker_frame_agrees_and_another_texture_does_not():
    reference = _view(REST)
    darker = DepthImage(reference.depth, reference.intensity - 40)
    assert measure_alignment(darker, reference, REST, CAMERA).photometric_inlier_ratio == 1
    noise = np.random.default_rng(0).uniform(0, 255, CAMERA.shape).astype(np.float32)
    found = measure_alignment(DepthImage(reference.depth, noise), reference, REST, CAMERA)
    assert found.inlier_ratio == 1
    assert found.photometric_inlier_ratio < 0.5
    assert evaluate_alignment(found, VIEW_THRESHOLDS) == TrackingStatus.PHOTOMETRIC_MISMATCH


def test_what_does_not_fit_is_named():
    reference = _view(REST)
    away = make_pose(so3_exp([0.0, np.pi, 0.0]), np.zeros(3))
    assert measure_alignment(reference, reference, away, CAMERA).overlap == 0
    found = measure_alignment(reference, reference, away, CAMERA)
    assert evaluate_alignment(found, VIEW_THRESHOLDS) == TrackingStatus.LITTLE_OVERLAP
    far = make_pose(np.eye(3), [0.0, 0.35, 0.0])
    found = measure_alignment(_view(far), reference, far, CAMERA)
    assert evaluate_alignment(found, VIEW_THRESHOLDS) == TrackingStatus.IMPLAUSIBLE_MOTION
    near = DepthImage(reference.depth * np.float32(0.8), reference.intensity)
    found = measure_alignment(near, reference, REST, CAMERA)
    assert evaluate_alignment(found, VIEW_THRESHOLDS) == TrackingStatus.GEOMETRIC_MISMATCH


_FIELDS = [field.name for field in fields(AcceptanceThresholds)]


@given(
    found=st.fixed_dictionaries({name: st.sampled_from([0.0, 0.4, 0.6, 1.0]) for name in _FIELDS}),
    demanded=st.fixed_dictionaries({}, optional={name: st.just(0.5) for name in _FIELDS}),
)
def test_a_refusal_names_a_figure_whose_repair_changes_the_decision(found, demanded):
    statistics, thresholds = AlignmentStatistics(**found), AcceptanceThresholds(**demanded)
    status = evaluate_alignment(statistics, thresholds)
    said = failed_demand(statistics, thresholds, status)
    assert bool(said) == (status != TrackingStatus.OK)
    record = np.array(
        [tuple(getattr(statistics, name) for name in _FIELDS)], thresholds.repeated(1).dtype
    )
    assert failed_demand(record[0], thresholds.repeated(1)[0], status) == said
    if said:
        limit = 60.0 if "rotation in degrees" in said else 0.5
        assert said.endswith(f" {limit:g}")
        value = float(said.split(",")[0].split()[-1])
        assert value > limit if "at most" in said else value < limit
        assert failed_demand(statistics, AcceptanceThresholds(), status) == ""


def test_pixels_without_a_reading_count_neither_way():
    reference, frame = _view(REST), _view(REST)
    frame.depth[:, :40] = 0
    reference.depth[:30] = 0
    found = measure_alignment(frame, reference, REST, CAMERA)
    assert found.overlap == pytest.approx(0.5, abs=0.05)
    assert found.inlier_ratio == 1


def test_many_motions_at_once_score_as_one_by_one_to_the_last_bit():
    away = make_pose(so3_exp([0.0, np.pi, 0.0]), np.zeros(3))
    motions = np.concatenate([MOTIONS, away[None], MOVED[None]])
    frame, reference = _view(MOVED), _view(REST)
    frame.depth[:, ::7], reference.depth[5:9] = 0, 0
    one_by_one = []
    for motion in motions:
        found = measure_alignment(frame, reference, motion, CAMERA, 600)
        one_by_one.append(found.overlap * (found.inlier_ratio + found.photometric_inlier_ratio))
    laid = overlay(frame, reference, motions, CAMERA, 600)
    np.testing.assert_array_equal(laid.scores, one_by_one)
    assert 0 == min(one_by_one) < max(one_by_one)


def test_starts_go_on_first_and_then_from_near_the_motion():
    turn, step = so3_exp([0.0, np.radians(11.0), 0.0]), [0.09, 0.01, 0.0]
    moved = make_pose(turn, step)
    frames = []
    for pose in (moved, REST):
        depth, _, color = ray_cast(pose, CAMERA)
        frames.append(DepthImage(depth.astype(np.float32), color.mean(-1).astype(np.float32)))
    starts = motion_hypotheses(*frames, MOVED, CAMERA)
    np.testing.assert_allclose(starts[0], MOVED, atol=1e-15)
    angles = [np.degrees(relative_angle(start[:3, :3], turn)) for start in starts[1:]]
    steps = [np.linalg.norm(start[:3, 3] - step) for start in starts[1:]]
    assert any(angle < 2 and step < 0.12 for angle, step in zip(angles, steps, strict=True))


def test_a_motion_that_goes_on_for_ever_stays_rigid():
    last, pose = MOVED @ REST, MOVED @ MOVED
    for _ in range(100):
        going_on = motion_hypotheses(_view(REST), _view(REST), invert(last) @ pose, CAMERA)[0]
        last, pose = pose, pose @ going_on
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_repetition_must_hardly_move_but_may_look_less_alike():
    still = AlignmentStatistics(
        overlap=0.9,
        inlier_ratio=1.0,
        photometric_inlier_ratio=0.95 * VIEW_THRESHOLDS.photometric_inlier_ratio,
        rotation_cos=1.0,
    )
    moving = replace(still, motion_m=0.05)
    assert evaluate_alignment(still, VIEW_THRESHOLDS) == TrackingStatus.PHOTOMETRIC_MISMATCH
    assert evaluate_alignment(moving, VIEW_THRESHOLDS.tentative) == TrackingStatus.OK
    confirmation = VIEW_THRESHOLDS.confirmation
    assert evaluate_alignment(still, confirmation) == TrackingStatus.OK
    assert evaluate_alignment(moving, confirmation) == TrackingStatus.IMPLAUSIBLE_MOTION


@wp.kernel
def _evaluate(
    statistics: wp.array(dtype=DeviceStatistics),
    thresholds: wp.array(dtype=DeviceThresholds),
    status: wp.array(dtype=wp.int32),
):
    b = wp.tid()
    status[b] = evaluate_on_device(statistics[b], thresholds[b])


@pytest.mark.parametrize(
    ("correlation", "inliers", "texture", "expected"),
    [
        (0.9, 0.95, 10.0, TrackingStatus.OK),
        (0.6, 0.95, 10.0, TrackingStatus.UNCERTAIN),
        (0.3, 0.95, 10.0, TrackingStatus.PHOTOMETRIC_MISMATCH),
        (0.9, 0.5, 10.0, TrackingStatus.PHOTOMETRIC_MISMATCH),
        (0.0, 0.99, 0.1, TrackingStatus.UNCERTAIN),  # depth alone never convinces
    ],
)
def test_the_maps_view_overrules_a_refusal_as_far_as_it_agrees(
    correlation, inliers, texture, expected
):
    view = AlignmentStatistics(
        overlap=0.9, inlier_ratio=inliers, correlation=correlation, texture=texture, relief_m=0.2
    )
    assert status_on_appeal(view) == expected


def test_kernels_decide_as_the_host_does():
    count, demanded = 300, AcceptanceThresholds(*[0.2] * 3, 0.8, 0.2, 0.2, 0.2, *[0.8] * 4, 0.2)
    shape = count, len(fields(AlignmentStatistics))
    values = np.random.default_rng(0).uniform(0, 1, shape)
    statistics = np.array([tuple(row) for row in values], dtype=DeviceStatistics.numpy_dtype())
    status = wp.zeros(count, dtype=wp.int32)
    arrays = [
        wp.array(statistics, dtype=DeviceStatistics),
        wp.array(demanded.repeated(count), dtype=DeviceThresholds),
    ]
    wp.launch(_evaluate, dim=count, inputs=arrays, outputs=[status])
    expected = [evaluate_alignment(AlignmentStatistics(*row.tolist()), demanded) for row in values]
    assert len(set(expected)) == len(TrackingStatus) - 2  # all but of a blank frame and of doubt
    np.testing.assert_array_equal(status.numpy(), expected)


@pytest.mark.parametrize(("offset_m", "is_inlier"), [(0.055, True), (0.065, False)])
def test_a_reading_is_an_inlier_within_the_noise_of_its_depth(offset_m, is_inlier):
    depth = np.full(CAMERA.shape, 2.0, dtype=np.float32)  # there the rule says 2 cm + 4 cm
    wall = DepthImage(depth, np.zeros_like(depth))
    frame = DepthImage(depth + np.float32(offset_m), wall.intensity)
    assert measure_alignment(frame, wall, REST, CAMERA).inlier_ratio == is_inlier


@pytest.mark.parametrize(("levels", "is_inlier"), [(19, True), (21, False)])
def test_grey_values_are_alike_within_twenty_levels_of_their_median(levels, is_inlier):
    reference = _view(REST)
    frame = DepthImage(reference.depth, reference.intensity + 50)
    frame.intensity[:20] += levels
    expected = 1.0 if is_inlier else pytest.approx(2 / 3, abs=0.02)
    assert measure_alignment(frame, reference, REST, CAMERA).photometric_inlier_ratio == expected


@pytest.mark.parametrize(
    ("nearer", "brighter", "status"),
    [
        (0.18, 0.0, TrackingStatus.OK),
        (0.0, 0.07, TrackingStatus.OK),
        (0.18, 0.07, TrackingStatus.OK),
        (0.4, 0.0, TrackingStatus.GEOMETRIC_MISMATCH),
        (0.0, 0.25, TrackingStatus.PHOTOMETRIC_MISMATCH),
    ],
)
def test_a_right_pose_is_accepted_while_something_stands_in_the_view(nearer, brighter, status):
    """Shares of the rows that a thing 30 cm before the wall covers, and another brightness."""
    reference, frame = _view(REST), _view(MOVED)
    frame.depth[: round(nearer * CAMERA.height)] -= 0.3
    frame.intensity[CAMERA.height - round(brighter * CAMERA.height) :] += 60
    found = measure_alignment(frame, reference, MOVED, CAMERA)
    assert evaluate_alignment(found, VIEW_THRESHOLDS) == status
