"""The reference that maps are judged against, in a room whose geometry is known."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BOXES, ROOM_HIGH, ROOM_LOW, BoxScene

from ms_slam_env.camera import xtion
from ms_slam_env.evaluation import map_truth
from ms_slam_env.evaluation.map_quality import map_quality
from ms_slam_env.geometry import look_at

START = np.array([-1.0, -1.0, 1.2])


@pytest.fixture(scope="module")
def scene() -> BoxScene:
    return BoxScene(0)


@pytest.fixture(scope="module")
def reference(scene: BoxScene) -> np.ndarray:
    return map_truth.surface_nearby(scene, START)


def test_viewpoints_are_reachable_on_a_straight_way(scene: BoxScene) -> None:
    viewpoints = map_truth.reachable_viewpoints(scene, START)
    np.testing.assert_array_equal(viewpoints[0], START)
    assert len(viewpoints) > 10
    assert np.linalg.norm(viewpoints - START, axis=1).max() <= map_truth.REACH_M
    assert (scene.clearance(viewpoints) >= 0.1 - 1e-9).all()


def test_reference_lies_within_the_radius(reference: np.ndarray) -> None:
    assert np.linalg.norm(reference - START, axis=1).max() <= map_truth.RADIUS_M


def test_reference_has_all_open_wall_and_none_hidden(
    scene: BoxScene, reference: np.ndarray
) -> None:
    """The wall x = -2 is open to view; nothing sees the far side of a box at x = 1.6."""
    points = scene.surface_points(map_truth.REFERENCE_SPACING_M)[0]
    near = points[np.linalg.norm(points - START, axis=1) <= map_truth.RADIUS_M]
    wall = np.isclose(near[:, 0], ROOM_LOW[0])
    assert np.isclose(reference[:, 0], ROOM_LOW[0]).sum() == wall.sum()
    low, high = BOXES[0]
    far_side = np.isclose(points[:, 0], high[0]) & (points[:, 1] < high[1] - 0.1)
    far_side &= (points[:, 1] > low[1] + 0.1) & (points[:, 2] < 0.5)
    assert far_side.any()
    assert not (
        np.isclose(reference[:, 0], high[0])
        & (np.abs(reference[:, 1]) < 0.3)
        & (reference[:, 2] < 0.5)
    ).any()


def test_reference_is_the_same_every_time(scene: BoxScene, reference: np.ndarray) -> None:
    np.testing.assert_array_equal(map_truth.surface_nearby(scene, START), reference)


def test_perfect_map_scores_one_and_half_a_map_loses_recall_only(reference: np.ndarray) -> None:
    surface = np.concatenate([reference, ROOM_HIGH[None]])
    whole = map_quality(reference, surface, reference=reference)
    assert whole["f_score_2cm"] == whole["f_score_5cm"] == whole["rcm"] == 1
    half = map_quality(reference[reference[:, 0] < START[0]], surface, reference=reference)
    assert half["precision_2cm"] == 1
    assert half["recall_5cm"] < 0.8
    assert half["f_score_5cm"] == pytest.approx(2 * half["recall_5cm"] / (1 + half["recall_5cm"]))


def test_shifted_map_loses_both_but_not_rer(reference: np.ndarray) -> None:
    shifted = map_quality(reference + 0.1, reference, reference=reference)
    assert shifted["f_score_5cm"] < 0.3
    assert shifted["rer_m"] < 0.03  # registered first


def test_empty_map_scores_zero(reference: np.ndarray) -> None:
    empty = map_quality(np.empty((0, 3)), reference, reference=reference)
    assert empty["f_score_5cm"] == empty["rcm"] == empty["map_points"] == 0
    assert np.isnan(empty["rer_m"])


def test_from_anywhere_in_the_scene_more_is_seen_than_nearby(scene: BoxScene) -> None:
    nearby = map_truth.surface_nearby(scene, START)
    whole = map_truth.surface_of_scene(scene, START)
    far = np.linalg.norm(whole - START, axis=1) > map_truth.RADIUS_M
    assert far.any()
    assert len(whole) > len(nearby)
    elsewhere = map_truth.surface_of_scene(scene, START + np.array([0.2, 0.2, 0.0]))
    assert abs(len(elsewhere) - len(whole)) < 0.02 * len(whole)  # where it starts hardly matters


def test_viewpoints_all_over_are_free(scene: BoxScene) -> None:
    viewpoints = map_truth.connected_viewpoints(scene, START)
    np.testing.assert_array_equal(viewpoints[0], START)
    assert (scene.clearance(viewpoints[1:]) >= 0.1).all()
    assert np.ptp(viewpoints, axis=0).min() > 1.0


def test_a_camera_maps_what_is_in_its_image_and_not_behind_it(scene: BoxScene) -> None:
    camera = xtion("160x120")
    pose = look_at(START, START + np.array([1.0, 0.0, 0.0]))
    seen = map_truth.surface_of_views(scene, pose[None], camera)
    assert len(seen) > 100
    local = (seen - START) @ pose[:3, :3]
    assert (local[:, 2] > 0).all()
    pixels = camera.project(local)
    assert (np.abs(pixels - (camera.cx, camera.cy)) <= (80, 60)).all()
    everywhere = map_truth.surface_nearby(scene, START)
    back = look_at(START, START - np.array([1.0, 0.0, 0.0]))
    both = map_truth.surface_of_views(scene, np.stack([pose, back]), camera)
    assert len(seen) < len(both) < len(everywhere)
