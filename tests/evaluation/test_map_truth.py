"""The reference that maps are judged against, in a room whose geometry is known."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BOXES, ROOM_HIGH, ROOM_LOW, BoxScene

from ms_slam_env.evaluation import map_truth
from ms_slam_env.evaluation.map_quality import map_quality

START = np.array([-1.0, -1.0, 1.2])


@pytest.fixture(scope="module")
def scene() -> BoxScene:
    return BoxScene(0)


@pytest.fixture(scope="module")
def reference(scene: BoxScene) -> np.ndarray:
    return map_truth.reference_surface(scene, START)


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
    np.testing.assert_array_equal(map_truth.reference_surface(scene, START), reference)


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
