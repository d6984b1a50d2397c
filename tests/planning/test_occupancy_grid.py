"""The grid against a slow loop over rays, and a room whose inside is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.camera import xtion
from ms_slam_env.geometry import look_at, make_pose, so3_exp, transform_points
from ms_slam_env.planning import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    reachable_positions,
    shortest_ways,
    surrounding_occupancy,
)

K = xtion("80x60").scaled(0.5)
WALL = np.full(K.shape, 2.0, dtype=np.float32)


def slow_states(depth, pose, grid):
    """Cells that some ray passes, and those at which one ends, by a loop over pixels."""
    passed, struck = set(), set()
    rays = K.rays()
    for v in range(K.height):
        for u in range(K.width):
            z = depth[v, u]
            if not z:
                continue
            end = min(grid.reach_m, z - 0.5 * grid.cell_m)
            for s in np.arange(0.1, end, 0.7 * grid.cell_m):
                passed.add(tuple(np.floor(transform_points(pose, s * rays[v, u]) / grid.cell_m)))
            if z < grid.reach_m:
                struck.add(tuple(np.floor(transform_points(pose, z * rays[v, u]) / grid.cell_m)))
    return passed - struck, struck


@settings(max_examples=10, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    place=st.tuples(*[st.floats(-5, 5)] * 3),
    seed=st.integers(0, 99),
)
def test_a_view_marks_the_cells_that_a_loop_over_its_rays_does(turn, place, seed):
    rng = np.random.default_rng(seed)
    depth = rng.choice([0, 0.3, 1.0, 2.5, 6.0], K.shape).astype(np.float32)
    # Not along the faces of cells, where single precision may fall to either side.
    pose = make_pose(so3_exp(np.array(turn) + 0.0123), np.array(place) + 0.0271)
    grid = OccupancyGrid()
    grid.integrate(depth, pose, K)
    free, struck = slow_states(depth, pose, grid)
    for cells, state in ((free, FREE), (struck, OCCUPIED)):
        found = grid.states_of((np.array(sorted(cells)) + 0.5) * grid.cell_m)
        assert (found == state).mean() > 0.99
    known = np.count_nonzero(grid.log_odds)
    assert abs(known - len(free) - len(struck)) <= 0.01 * known + 2


def test_what_was_never_seen_is_unknown_anywhere():
    grid = OccupancyGrid()
    points = np.array([[0.0, 0, 0], [1e3, -1e3, 5]])
    assert (grid.states_of(points) == UNKNOWN).all()
    grid.integrate(WALL, np.eye(4), K)
    assert (grid.states_of(points - np.array([0, 0, 1])) == UNKNOWN).all()
    assert grid.states_of(np.array([[0, 0, 1.0], [0, 0, 2.05], [0, 0, 2.6]])).tolist() == [1, 2, 0]


def test_growing_moves_nothing():
    grid = OccupancyGrid()
    grid.integrate(WALL, np.eye(4), K)
    points = np.random.default_rng(0).uniform(-3, 3, (5000, 3))
    before = grid.states_of(points)
    for x in (-20.0, 20.0):
        grid.integrate(WALL, make_pose(np.eye(3), [x, x, x]), K)
    np.testing.assert_array_equal(grid.states_of(points), before)


def test_a_thing_that_is_gone_is_unlearned():
    grid = OccupancyGrid()
    for _ in range(20):
        grid.integrate(np.minimum(WALL, 1.0), np.eye(4), K)
    there = np.array([[0, 0, 1.04]])
    assert grid.states_of(there) == [OCCUPIED]
    for _ in range(20):
        grid.integrate(WALL, np.eye(4), K)
    assert grid.states_of(there) == [FREE]


def test_rays_without_a_reading_leave_space_unknown_but_are_counted():
    grid = OccupancyGrid()
    for _ in range(3):
        grid.integrate(0 * WALL, np.eye(4), K)
    assert not grid.log_odds.any()
    assert grid.blanks.max() == 3
    assert grid.blanks[tuple(grid.cells_of(np.array([0, 0, 2.0])))] == 3


def test_what_can_be_reached_is_what_a_flood_fill_reaches():
    grid = OccupancyGrid()
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        eye = np.zeros(3)
        grid.integrate(WALL, look_at(eye, [np.cos(angle), np.sin(angle), 0]), K)
    start = np.array([0.5, 0.0, 0.0])
    found = reachable_positions(grid, start, 1.5)
    assert {tuple(cell) for cell in grid.cells_of(found)} == flood_fill(grid, start, 1.5)
    assert len(found) > 100


@pytest.mark.parametrize("seed", range(4))
def test_what_can_be_reached_among_scattered_cells_up_to_the_edge_of_the_grid(seed):
    rng = np.random.default_rng(seed)
    grid = OccupancyGrid()
    grid.first = np.array([-4, 7, 0])
    grid.log_odds = np.where(rng.random((30, 24, 14)) < 0.06, 3, -1).astype(np.int8)
    grid.log_odds[:, :, 10:] = 0
    grid.log_odds[8:13, 8:13, 3:8] = -1
    start = grid.centres_of(np.array([10, 10, 5]))
    found = reachable_positions(grid, start, 1.1)
    assert {tuple(cell) for cell in grid.cells_of(found)} == flood_fill(grid, start, 1.1)
    assert len(found) > 100


def flood_fill(grid, start, radius):
    axes = [
        np.array(a) for a in ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1])
    ]
    here = grid.cells_of(start)
    reach = int(radius / grid.cell_m)

    def is_free(cell):
        inside = (np.abs(cell - here) <= reach).all()
        return inside and bool(grid.states_of(grid.centres_of(cell)[None])[0] == FREE)

    def is_open(cell):
        return is_free(cell) and all(is_free(cell + axis) for axis in axes)

    assert is_open(here)
    seen, todo = {tuple(here)}, [here]
    while todo:
        cell = todo.pop()
        for axis in axes:
            if tuple(cell + axis) not in seen and is_open(cell + axis):
                seen.add(tuple(cell + axis))
                todo.append(cell + axis)
    return {tuple(int(n) for n in cell) for cell in seen}


def test_ways_are_as_short_as_by_relaxing_every_edge_until_nothing_changes():
    rng = np.random.default_rng(0)
    grid = OccupancyGrid()
    grid.first = np.array([3, -2, 5])
    grid.log_odds = np.full((24, 22, 12), -1, dtype=np.int8)
    for x, y in rng.integers(2, 20, (12, 2)):
        grid.log_odds[x, y] = 3
    grid.log_odds[14, :16] = 3
    grid.blanks = np.zeros_like(grid.log_odds)
    start = grid.centres_of(np.array([4, 5, 6]))
    ways = shortest_ways(grid, start, 5.0)
    np.testing.assert_allclose(ways.positions[0], start)
    apart = np.linalg.norm(ways.positions[:, None] - ways.positions[None], axis=-1)
    edges = np.where(apart < 0.2 * np.sqrt(3) + 1e-6, apart, np.inf)
    lengths = np.where(np.arange(len(apart)) == 0, 0.0, np.inf)
    while True:
        shorter = (lengths[:, None] + edges).min(axis=0)
        if (shorter >= lengths).all():
            break
        lengths = np.minimum(lengths, shorter)
    np.testing.assert_allclose(ways.lengths, lengths, atol=1e-9)
    assert (ways.positions[:, 0] > 1.8).any()  # behind the wall
    for end in (0, len(lengths) // 2, len(lengths) - 1):
        legs = np.diff(ways.to(end), axis=0)
        assert np.linalg.norm(legs, axis=1).sum() == pytest.approx(lengths[end])
    free = {tuple(cell) for cell in grid.cells_of(reachable_positions(grid, start, 5.0))}
    assert {tuple(cell) for cell in grid.cells_of(ways.positions)} <= free


def test_where_nothing_is_known_the_way_ends_where_it_begins():
    ways = shortest_ways(OccupancyGrid(), np.ones(3), 2.5)
    np.testing.assert_array_equal(ways.to(0), np.ones((1, 3)))
    assert ways.lengths.tolist() == [0]


def test_nothing_known_nowhere_to_go():
    assert reachable_positions(OccupancyGrid(), np.zeros(3), 2.5).shape == (0, 3)


@pytest.mark.parametrize("far", [1e6, -1e6])
def test_a_position_far_from_all_that_is_known_can_go_nowhere(far):
    grid = OccupancyGrid()
    grid.integrate(WALL, np.eye(4), K)
    assert reachable_positions(grid, np.full(3, far), 1.0).shape == (0, 3)


CAMERA_K = xtion("80x60")


def grid_of(pose, depth_m):
    grid = OccupancyGrid()
    grid.integrate(np.full(CAMERA_K.shape, depth_m, np.float32), pose, CAMERA_K)
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
