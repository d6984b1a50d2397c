"""The observation `map`: of the space that the episode's frames have carved, and that alone."""

import numpy as np
import pytest
from small_env import small_env

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.errors import InputError
from ms_slam_env.planning import OccupancyGrid, expected_gain, surrounding_occupancy

BLOCKS = 2 * 10 * 6 * 10, 2 * 8 * 4 * 8


def make(observation="map", **options):
    return small_env(observation=observation, **options)


def test_it_is_what_a_grid_carved_from_the_same_frames_says():
    env = make()
    grid = OccupancyGrid()
    observation, info = env.reset(seed=0)
    for action in (0, 14, 3, 41, 26):
        own = env.unwrapped.episode
        assert info["tracking_ok"]
        grid.integrate(
            own.last_frame.depth, info["T_world_camera_estimate"], env.unwrapped.intrinsics
        )
        poses = env.unwrapped.candidate_poses()
        gain = expected_gain(grid, poses, env.unwrapped.intrinsics, (8, 6))
        fine, coarse = np.split(observation[-sum(BLOCKS) :], [BLOCKS[0]])
        expected = surrounding_occupancy(grid, poses[0], (10, 6, 10), 0.4)
        np.testing.assert_array_equal(fine.reshape(2, 10, 6, 10), expected)
        assert coarse.max() > 0
        shown = observation[-sum(BLOCKS) - 50 : -sum(BLOCKS)]
        np.testing.assert_allclose(shown, [*(gain / gain.max()), gain.max()], rtol=1e-5)
        assert env.observation_space.contains(observation)
        observation, *_, info = env.step(action)


def test_it_begins_with_the_features():
    seen = {name: make(name).reset(seed=3)[0] for name in ("features", "map")}
    np.testing.assert_array_equal(seen["map"][: len(seen["features"])], seen["features"])


def test_an_episode_forgets_the_one_before():
    env = make()
    first, _ = env.reset(seed=1)
    env.step(14)
    again, _ = env.reset(seed=1)
    np.testing.assert_array_equal(again, first)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda grid: setattr(grid, "log_odds", grid.log_odds[:1]), "shape"),
        (lambda grid: setattr(grid, "blanks", grid.blanks.astype(int)), "int64"),
        (lambda grid: setattr(grid, "first", np.array([0, 0, 10**12])), "another space"),
        (lambda grid: setattr(grid, "cell_m", 0.2), "cell_m is 0.2"),
        (lambda grid: delattr(grid, "first"), "first"),
    ],
)
def test_a_damaged_grid_is_refused_and_nothing_changes(change, said):
    env = make()
    env.reset(seed=0)
    state = env.unwrapped.save_state()
    change(state["episode"].occupancy)
    with pytest.raises(InputError, match=said):
        env.unwrapped.load_state(state)
    env.step(0)


def test_an_episode_without_a_grid_is_not_taken():
    env = make()
    env.reset(seed=0)
    state = env.unwrapped.save_state()
    state["episode"].occupancy = None
    with pytest.raises(InputError, match=r"episode\.occupancy is missing"):
        env.unwrapped.load_state(state)
