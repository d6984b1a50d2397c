"""The verdict on real maps with known second copies, and its pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from ms_slam_experiments.arm_experiment import (
    RED,
    describe,
    overview_pose,
    save_map_picture,
)
from ms_slam_experiments.shared.duplicate_objects import (
    JudgedMap,
    MapConsistency,
    ObjectConsistency,
    judge_map,
    labelled_surface,
    labelled_view,
)

from ms_slam_env import slam as slam_backends
from ms_slam_env.camera import xtion
from ms_slam_env.geometry import invert, make_pose, transform_points
from ms_slam_env.sensor.scene_cache import get_sensor


def map_with_offset(offset_m: float) -> tuple[JudgedMap, np.ndarray]:
    """A table seen from two sides, the second time at poses that are off to the left."""
    sensor = get_sensor("table", 1001, xtion("160x120"), "kinect")
    start = sensor.scene.sample_start(np.random.default_rng(1001))
    slam = slam_backends.make("surfel", sensor.intrinsics)
    views = []
    for k in range(24):
        step = make_pose(np.eye(3), np.array([0.01 * k, 0.0, 0.0]))
        truth = start @ step
        estimate = truth.copy()
        estimate[:3, 3] += offset_m * truth[:3, 0] * (k >= 12)
        slam.fuse(sensor.capture(truth, index=k, seed=0), estimate)
        views.append(labelled_view(sensor, truth, estimate))
    cameras = np.array([view.T_world_camera_estimate[:3, 3] for view in views])
    return judge_map(slam.surface_points(), slam.surface_colors(), views, sensor), cameras


@pytest.mark.parametrize(("offset_m", "success"), [(0.0, True), (0.02, True), (0.15, False)])
def test_a_map_fails_when_its_second_half_is_off(
    offset_m: float, success: bool, tmp_path: Path
) -> None:
    judged, cameras = map_with_offset(offset_m)
    assert judged.consistency.success is success
    assert len(judged.consistency.objects) > 5
    small = {judged.name(item) for item in judged.consistency.duplicated}
    if not success:
        # of what the map shows twice, most are things on the table
        assert len(small - {"floor", "ceiling", "table"}) >= 3
    path = save_map_picture(judged, cameras, tmp_path / "map.png", "a table")
    picture = cv2.imread(str(path))[..., ::-1]
    assert bool((picture == RED).all(axis=2).sum() > 500) is not success


def test_an_empty_map_shows_nothing_twice() -> None:
    judged = judge_map(
        np.zeros((0, 3)),
        np.zeros((0, 3)),
        [],
        get_sensor("table", 1001, xtion("160x120"), "kinect"),
    )
    assert judged.consistency.success
    assert judged.consistency.objects == ()


def test_the_whole_surface_counts_as_true() -> None:
    points, owner = labelled_surface("table", 1001)
    mesh = get_sensor("table", 1001, xtion("160x120"), "kinect").scene.mesh
    assert set(owner) == set(mesh.face_label)
    area = 0.5 * np.linalg.norm(
        np.cross(*np.moveaxis(np.diff(mesh.vertices[mesh.faces], axis=1), 1, 0)), axis=1
    )
    assert len(points) == pytest.approx(area.sum() / 0.01**2, rel=1e-3)


def test_the_overview_looks_from_behind_and_above() -> None:
    points = np.random.default_rng(0).normal(0, 0.1, (100, 3))
    cameras = np.array([[1.0, 0.0, 0.5], [1.2, 0.0, 0.7]])
    pose = overview_pose(points, cameras)
    assert pose[0, 3] > 1.2
    assert pose[2, 3] > 0.7
    ahead = transform_points(invert(pose), np.median(points, axis=0))
    assert np.allclose(ahead[:2], 0, atol=1e-9)
    assert ahead[2] > 0


def test_a_verdict_in_words() -> None:
    objects = tuple(ObjectConsistency(k, 200, 0.11 + 0.01 * k, 0.5, True) for k in range(7))
    labels = tuple(f"thing {k}" for k in range(7))
    point, colour = np.zeros((1, 3)), np.zeros((1, 3), dtype=np.uint8)
    judged = JudgedMap(point, colour, MapConsistency(objects, np.zeros(1, bool)), labels)
    text = describe(judged)
    assert text.startswith("failure, twice there: thing 6 (17 %), thing 5 (16 %)")
    assert text.endswith("and 2 more")
    clean = JudgedMap(point, colour, MapConsistency((), np.zeros(1, bool)), labels)
    assert describe(clean).startswith("success")
