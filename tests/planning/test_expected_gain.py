"""Expected gain against a slow loop, and where the answer is known."""

import numpy as np

from ms_slam_env.camera import xtion
from ms_slam_env.geometry import look_at, make_pose, so3_exp, transform_points
from ms_slam_env.planning import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, expected_gain, held_gain

K = xtion("80x60").scaled(0.5)


def slow_gain(grid, pose, across, down):
    total = 0.0
    dz = 0.8 * grid.cell_m
    for v in (np.arange(down) + 0.5) / down * K.height - 0.5:
        for u in (np.arange(across) + 0.5) / across * K.width - 0.5:
            ray = K.rays_at(np.array([u, v]))
            chance = 1.0
            for z in np.arange(0.3, grid.reach_m, dz):
                point = transform_points(pose, z * ray)
                state = grid.states_of(point[None])[0]
                if state == OCCUPIED:
                    break
                if state == UNKNOWN:
                    cell = grid.cells_of(point)
                    inside = (cell >= 0).all() and (cell < grid.blanks.shape).all()
                    blank = grid.blanks[tuple(cell)] if inside else 0
                    total += chance * 0.7**blank * z**2 * dz
                    chance *= 0.85**0.8
    return total * K.width * K.height / (across * down * K.fx * K.fy)


def seen_grid():
    rng = np.random.default_rng(3)
    grid = OccupancyGrid()
    depth = rng.choice([0, 1.5, 2.5], K.shape).astype(np.float32)
    grid.integrate(depth, look_at([0, 0, 0], [1, 0, 0]), K)
    return grid


def test_gain_is_that_of_a_slow_loop():
    grid = seen_grid()
    rng = np.random.default_rng(0)
    poses = np.stack([look_at(rng.normal(0, 0.5, 3), [2, 0, 0]) for _ in range(4)])
    expected = [slow_gain(grid, pose, 4, 3) for pose in poses]
    np.testing.assert_allclose(expected_gain(grid, poses, K, (4, 3)), expected, rtol=0.03)


def test_an_unknown_world_is_worth_the_same_everywhere_and_a_known_one_less():
    nowhere = np.stack([make_pose(np.eye(3), [x, 0, 0]) for x in (0.0, 50.0)])
    gain = expected_gain(OccupancyGrid(), nowhere, K)
    assert gain[0] == gain[1] > 0
    grid = OccupancyGrid()
    grid.integrate(np.full(K.shape, 2.0, np.float32), np.eye(4), K)
    here, away = expected_gain(grid, nowhere, K)
    assert here < 0.2 * away
    assert grid.states_of(np.array([[0, 0, 1.0]])) == [FREE]


def test_a_view_without_readings_loses_its_worth():
    grid = OccupancyGrid()
    gains = []
    for _ in range(5):
        gains.append(expected_gain(grid, np.eye(4)[None], K)[0])
        grid.integrate(np.zeros(K.shape, np.float32), np.eye(4), K)
    assert (np.diff(gains) < 0).all()
    assert gains[-1] < 0.6 * gains[0]


HERE = look_at([0.05, 0.02, 0.03], [1, 0.1, 0])
MOTIONS = np.stack(
    [
        np.eye(4),
        make_pose(so3_exp([0, 0.4, 0]), [0, 0, 0]),
        make_pose(so3_exp([0.3, 0, 0]), [0, 0, 0.15]),
        make_pose(np.eye(3), [0, 0, -0.2]),  # backwards, into what nobody has seen
    ]
)


def slow_held_gain(grid, motion, steps, across, down):
    first_seen, gains, pose = {}, [], HERE
    dz, k = 0.8 * grid.cell_m, K.width * K.height / (across * down * K.fx * K.fy)
    for step in range(steps):
        pose = pose @ motion
        if step and grid.states_of(pose[None, :3, 3])[0] != FREE:
            break
        gains.append(0.0)
        for v in (np.arange(down) + 0.5) / down * K.height - 0.5:
            for u in (np.arange(across) + 0.5) / across * K.width - 0.5:
                chance = 1.0
                for z in np.arange(0.3, grid.reach_m, dz):
                    point = transform_points(pose, z * K.rays_at(np.array([u, v])))
                    state = grid.states_of(point[None])[0]
                    if state == OCCUPIED:
                        break
                    if state == UNKNOWN:
                        cell = grid.cells_of(point)
                        block = tuple((cell + grid.first) // 2)
                        if first_seen.setdefault(block, step) == step:
                            inside = (cell >= 0).all() and (cell < grid.blanks.shape).all()
                            blank = grid.blanks[tuple(cell)] if inside else 0
                            gains[-1] += k * chance * 0.7**blank * z**2 * dz
                        chance *= 0.85**0.8
    return gains + [0.0] * (steps - len(gains))


def test_what_a_held_motion_shows_is_that_of_a_slow_loop():
    grid = seen_grid()
    found = held_gain(grid, HERE, MOTIONS, 4, K, (4, 3))
    slow = np.array([slow_held_gain(grid, motion, 4, 4, 3) for motion in MOTIONS])
    np.testing.assert_array_equal(found > 0, slow > 0)
    np.testing.assert_allclose(found, slow, rtol=0.1, atol=0.01 * slow.max())  # rays along faces


def test_the_first_step_is_the_gain_of_its_pose_and_nothing_counts_twice():
    grid = seen_grid()
    found = held_gain(grid, HERE, MOTIONS, 5, K)
    each = expected_gain(grid, HERE @ MOTIONS, K, (8, 6))
    np.testing.assert_allclose(found[:, 0], each, rtol=1e-5)
    assert not found[0, 1:].any()  # it stands still
    assert not found[3, 1:].any()  # it would have to leave what is known to be free
    way, turned = [], HERE
    for _ in range(5):
        turned = turned @ MOTIONS[1]
        way.append(turned)
    apart = expected_gain(grid, np.stack(way), K, (8, 6)).sum()
    assert each[1] < found[1].sum() < apart
