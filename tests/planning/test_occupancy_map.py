"""The map of frames against a grid carved from where the frames are known to be now."""

from types import SimpleNamespace

import numpy as np
import pytest

from ms_slam_env.camera import xtion
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.planning import OccupancyGrid, OccupancyMap

K = xtion("80x60").scaled(0.5)
RNG = np.random.default_rng(0)
POSES = [make_pose(so3_exp([0, 0.3 * n, 0.1]), [0.2 * n, 0.013, 0.021]) for n in range(6)]
DEPTHS = [RNG.uniform(1, 3, K.shape).astype(np.float32) for _ in POSES]
NOWHERE = np.zeros(0, dtype=np.int32), np.zeros((0, 4, 4))


class FakeSlam:
    """Counts frames, and says of them what it is told to say."""

    def __init__(self, counts=True):
        self.counts, self.frames_counted = counts, 0
        self.corrected = NOWHERE
        self.first_frames, self.joined_to = [0], [0]

    def tracked(self):
        self.frames_counted += self.counts

    def corrected_trajectory(self):
        return self.corrected

    def submaps(self):
        return SimpleNamespace(
            first_frames=np.array(self.first_frames), joined_to=np.array(self.joined_to)
        )


def carved(indices, poses=POSES):
    grid = OccupancyGrid()
    for index in indices:
        grid.integrate(DEPTHS[index], poses[index], K)
    return grid


def add(occupancy, slam, *indices):
    for index in indices:
        slam.tracked()
        occupancy.add(slam, DEPTHS[index], POSES[index], K)


def assert_same(found, expected):
    points = RNG.uniform(-4, 4, (20_000, 3))
    np.testing.assert_array_equal(found.states_of(points), expected.states_of(points))
    assert (expected.states_of(points) != 0).mean() > 0.01


@pytest.mark.parametrize("counts", [True, False])
def test_without_corrections_it_is_a_grid(counts):
    occupancy, slam = OccupancyMap(), FakeSlam(counts)
    add(occupancy, slam, 0, 1, 2, 3)
    assert_same(occupancy.grid, carved(range(4)))


@pytest.mark.parametrize("shift", [0.04, 0.3])
def test_frames_that_a_closed_loop_moved_are_carved_where_they_are_now(shift):
    occupancy, slam = OccupancyMap(), FakeSlam()
    add(occupancy, slam, 0, 1, 2, 3)
    moved = list(POSES)
    moved[2] = make_pose(POSES[2][:3, :3], POSES[2][:3, 3] + [shift, 0, 0])
    slam.corrected = np.array([1, 2], dtype=np.int32), np.stack([POSES[1], moved[2]])
    add(occupancy, slam, 4)
    expected = moved if shift > 0.05 else POSES  # less than half a cell is not worth the time
    assert_same(occupancy.grid, carved(range(5), expected))


def test_a_turn_counts_by_how_far_it_moves_what_is_far():
    occupancy, slam = OccupancyMap(), FakeSlam()
    add(occupancy, slam, 0, 1)
    moved = [POSES[0] @ make_pose(so3_exp([0, 0.05, 0]), np.zeros(3)), *POSES[1:]]
    slam.corrected = np.array([0], dtype=np.int32), moved[0][None]
    add(occupancy, slam, 2)
    assert_same(occupancy.grid, carved(range(3), moved))


def test_a_new_submap_is_shown_alone_until_it_is_joined():
    occupancy, slam = OccupancyMap(), FakeSlam()
    add(occupancy, slam, 0, 1)
    slam.first_frames, slam.joined_to = [0, 2], [0, 1]
    add(occupancy, slam, 2, 3)
    assert_same(occupancy.grid, carved([2, 3]))
    slam.joined_to = [0, 0]
    moved = [*POSES[:2], *(make_pose(np.eye(3), [0.5, 0, 0]) @ pose for pose in POSES[2:])]
    slam.corrected = np.array([2, 3], dtype=np.int32), np.stack(moved[2:4])
    slam.tracked()
    occupancy.add(slam, DEPTHS[4], moved[4], K)
    assert_same(occupancy.grid, carved(range(5), moved))
