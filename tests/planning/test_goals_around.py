"""Views around a camera and what they would gain, against one pose and one cell at a time."""

import numpy as np
import pytest

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import look_at, make_pose
from ms_slam_env.planning import OccupancyGrid, expected_gain, reachable_positions
from ms_slam_env.planning.expected_gain import look_from
from ms_slam_env.planning.goals_around import NUM_GOALS, NUM_POSITIONS, gain_around, goals_around

CAMERA = Intrinsics(40.0, 40.0, 31.5, 23.5, 64, 48)
HERE = look_at(np.array([0.05, 0.05, 1.05]), np.array([2.0, 0.9, 0.8]))


@pytest.fixture
def grid():
    """A room of 3 m known to be free, a wall with a gap in it, and unknown space beyond."""
    made = OccupancyGrid()
    made.log_odds = np.zeros((60, 60, 30), dtype=np.int8)
    made.blanks = np.zeros_like(made.log_odds)
    made.first = np.array([-30, -30, 0])
    made.log_odds[10:50, 10:50, 2:20] = -3
    made.log_odds[38, 10:50, 2:20] = 5
    made.log_odds[20, 10:50, 2:20] = 5
    made.log_odds[20, 30:33, 8:14] = -2
    return made


def test_gains_are_those_of_each_pose_whose_cell_can_be_gone_to(grid):
    free = reachable_positions(grid, HERE[:3, 3], 2.5)
    gain, goals = gain_around(grid, HERE, CAMERA, free), goals_around(HERE)
    reached = {tuple(cell) for cell in grid.cells_of(free)}
    led_to = 0
    for k, goal in enumerate(goals):
        own = expected_gain(grid, goal[None], CAMERA, (6, 4))[0]
        leads = tuple(grid.cells_of(goal[:3, 3])) in reached or not (goal - HERE)[:3, 3].any()
        led_to += leads
        assert gain[k] == pytest.approx(own if leads else 0.0, rel=1e-5)
    assert 24 < led_to < NUM_GOALS
    assert gain.max() > 0.1


def test_a_view_says_how_far_its_rays_go_before_they_meet_something(grid):
    pose = look_at(np.array([0.05, 0.05, 1.05]), np.array([0.95, 0.05, 1.05]))
    gain, depth = look_from(grid, pose[None], CAMERA, (16, 12))
    np.testing.assert_array_equal(gain, expected_gain(grid, pose[None], CAMERA, (16, 12)))
    middle = depth.reshape(12, 16)[4:8, 2:14]
    assert (
        np.abs(middle - 0.75).max() <= 0.1
    )  # the wall's cells begin 0.8 m from the world's origin
    assert not look_from(OccupancyGrid(), pose[None], CAMERA, (16, 12))[1].any()


def test_goals_begin_with_the_view_ahead_and_are_level_or_tilted():
    goals = goals_around(HERE)
    assert goals.shape == (NUM_GOALS, 4, 4)
    ahead = HERE[:2, 2] / np.linalg.norm(HERE[:2, 2])
    np.testing.assert_allclose(goals[0, :2, 2], ahead, atol=1e-12)
    np.testing.assert_allclose(goals[:, 2, 0], 0, atol=1e-12)  # upright: right is level
    np.testing.assert_allclose(goals[: 8 * NUM_POSITIONS, 2, 2], 0, atol=1e-12)
    np.testing.assert_allclose(np.abs(goals[8 * NUM_POSITIONS :, 2, 2]), np.sin(0.5), atol=1e-12)
    np.testing.assert_allclose(goals[8, :3, 3], HERE[:3, 3] + [*(0.5 * ahead), 0], atol=1e-12)
    assert len(np.unique(np.round(goals, 9), axis=0)) == NUM_GOALS


def test_a_world_turned_by_a_right_angle_looks_the_same(grid):
    turned = OccupancyGrid()
    turned.log_odds = np.ascontiguousarray(np.rot90(grid.log_odds))
    turned.blanks, turned.first = np.zeros_like(turned.log_odds), grid.first.copy()
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    there = make_pose(R, np.zeros(3)) @ HERE
    expected = gain_around(grid, HERE, CAMERA, reachable_positions(grid, HERE[:3, 3], 2.5))
    free = reachable_positions(turned, there[:3, 3], 2.5)
    found = gain_around(turned, there, CAMERA, free)
    assert np.median(np.abs(found - expected)) < 1e-5
    np.testing.assert_allclose(found, expected, atol=0.05)  # rays along faces of cells


def test_nothing_is_led_to_where_nothing_is_known():
    gain = gain_around(OccupancyGrid(), HERE, CAMERA, np.zeros((0, 3)))
    stays = (goals_around(HERE)[:, :3, 3] == HERE[:3, 3]).all(axis=1)
    assert stays.sum() == 24
    assert (gain[stays] > 0).all()
    assert not gain[~stays].any()
