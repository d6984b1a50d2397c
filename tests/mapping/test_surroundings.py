"""Blocks around a camera against a loop over them, and a wall whose place is known."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.camera import xtion
from ms_slam_env.geometry import make_pose, so3_exp, transform_points
from ms_slam_env.mapping import FREE, OCCUPIED, OccupancyGrid, surrounding_occupancy

K = xtion("80x60")


def grid_of(pose, depth_m):
    grid = OccupancyGrid()
    grid.integrate(np.full(K.shape, depth_m, np.float32), pose, K)
    return grid


@settings(max_examples=10, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    place=st.tuples(*[st.floats(-2, 2)] * 3),
    blocks=st.tuples(*[st.integers(1, 5)] * 3),
    block_m=st.floats(0.05, 1),
)
def test_blocks_are_those_of_a_loop(turn, place, blocks, block_m):
    grid = grid_of(np.eye(4), 1.5)
    pose = make_pose(so3_exp(np.array(turn)), place)
    found = surrounding_occupancy(grid, pose, blocks, block_m)
    assert found.dtype == np.float32
    n = min(5, int(np.ceil(block_m / grid.cell_m)))
    for block in np.ndindex(*blocks):
        corner = (np.array(block) - np.array(blocks) / 2) * block_m
        points = corner + (np.array(list(np.ndindex(n, n, n))) + 0.5) * block_m / n
        states = grid.states_of(transform_points(pose, points))
        expected = [(states == FREE).mean(), (states == OCCUPIED).mean()]
        # Single precision may fall to either side of a cell's face.
        np.testing.assert_allclose(found[(slice(None), *block)], expected, atol=0.03 + 1 / n**3)


def test_a_wall_ahead_is_ahead_wherever_the_camera_stands():
    pose = make_pose(so3_exp([0.3, -1.2, 0.4]), [3.0, -2.0, 1.0])
    free, occupied = surrounding_occupancy(grid_of(pose, 1.25), pose, (6, 6, 8), 0.5)
    assert occupied[3, 3].argmax() == 6  # from 1.0 to 1.5 m
    assert (free[2:4, 2:4, 5] > 0.6).all()
    assert not free[:, :, :4].any()  # nothing is known of what lies behind
