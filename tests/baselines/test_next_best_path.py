"""Goals chosen by what the whole way shows: which way is compared, what it counts, what it does."""

import gymnasium as gym
import numpy as np
import pytest
from ms_slam_baselines.nbv import NextBestView
from ms_slam_baselines.next_best_path import NextBestPath
from ms_slam_baselines.view_goals import poses_along, poses_between

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, look_at, make_pose, relative_angle, so3_exp
from ms_slam_env.mapping import expected_gain
from ms_slam_env.mapping.view_goals import distance_in_steps


def played(planner_class=NextBestPath, steps=8, look=lambda *_: None, **options):
    """A planner after some steps, and its actions; looked at whenever it chose a goal."""
    env = gym.make(
        "MSActiveSLAM-Room-v0",
        scene="table",
        scene_seed=0,
        image_size="80x60",
        disable_env_checker=True,
    )
    observation, info = env.reset(seed=0)
    planner = planner_class(env.unwrapped, seed=1, **options)
    planner.reset()
    choose = planner.choose_goal

    def choose_and_look(here):
        goal = choose(here)
        look(planner, here, goal)
        return goal

    planner.choose_goal = choose_and_look
    actions = []
    for _ in range(steps):
        actions.append(planner.act(observation, info))
        observation, *_, info = env.step(actions[-1])
    return planner, actions


def test_a_way_goes_step_by_step_through_free_space_to_its_goal():
    def look(planner, here, goal):
        way = planner.way_to(goal, here)
        before = np.concatenate([here[None], way[:-1]])
        pairs = zip(before, way, strict=True)
        apart = [distance_in_steps(a[None], b, *planner.steps)[0] for a, b in pairs]
        assert np.max(apart) <= 1 + 1e-6
        steps = np.count_nonzero(np.max(apart, axis=1) > 1e-6)
        assert steps < len(way)  # the goal is near by
        np.testing.assert_allclose(way[steps - 1 :], [goal] * (len(way) - steps + 1), atol=1e-9)
        for pose in way:
            check_pose(pose)

    played(look=look)


def test_of_the_goals_drawn_the_one_is_taken_whose_way_shows_most():
    compared = []

    def look(planner, here, goal):
        state = planner.rng.bit_generator.state
        planner.rng.bit_generator.state = planner.drawn_from
        poses, worth = planner.drawn_goals(here)
        planner.rng.bit_generator.state = state
        best = np.argsort(-worth * planner.is_new(poses, here), kind="stable")[:5]
        later = 0.7 ** np.arange(1, 21)
        values = [
            planner.shown_by(planner.way_to(pose, here)[None])[0] @ later for pose in poses[best]
        ]
        np.testing.assert_array_equal(goal, poses[best[np.argmax(values)]])
        compared.append(int(np.argmax(values)))

    class Remembers(NextBestPath):
        def drawn_goals(self, here):
            self.drawn_from = self.rng.bit_generator.state
            return super().drawn_goals(here)

    played(Remembers, look=look, compared=5, cost=-6 * np.log(0.7))
    assert any(compared)  # not always the one that nbv would take


def test_what_is_seen_on_the_way_counts_once():
    def look(planner, here, goal):
        way = planner.way_to(goal, here)
        shown = planner.shown_by(way[None])[0]
        alone = expected_gain(planner.map.grid, way, planner.env.intrinsics, (8, 6))
        assert shown[0] == pytest.approx(alone[0], rel=1e-4)
        assert (shown <= alone * 1.001 + 1e-6).all()

    played(look=look)


def test_it_moves_otherwise_than_nbv_and_twice_in_the_same_way():
    first, again = (played()[1] for _ in range(2))
    assert first == again
    assert first != played(NextBestView)[1]


def test_poses_along_a_way_with_a_corner():
    start, end = look_at([0, 0, 1], [1, 0, 1]), look_at([2, 2, 1], [2, 3, 1.5])
    way = np.array([[0, 0, 1], [2, 0, 1], [2, 2, 1]], dtype=float)
    found = poses_along(way, start, end, np.array([0.0, 0.25, 0.5, 0.75, 1.0]))
    np.testing.assert_allclose(found[[0, -1]], [start, end], atol=1e-12)
    np.testing.assert_allclose(found[1:4, :3, 3], [[1, 0, 1], [2, 0, 1], [2, 1, 1]])
    whole = relative_angle(start[:3, :3], end[:3, :3])
    angles = [relative_angle(start[:3, :3], pose[:3, :3]) for pose in found]
    np.testing.assert_allclose(angles, whole * np.arange(5) / 4, atol=1e-9)


def test_poses_along_a_straight_way_are_those_between_its_ends():
    start = make_pose(so3_exp([0.1, 0.2, 0.3]), [1, 2, 3])
    end = make_pose(so3_exp([0.5, -0.2, 0.4]), [2, 2, 1])
    way = np.stack([start[:3, 3], (start[:3, 3] + end[:3, 3]) / 2, end[:3, 3]])
    np.testing.assert_allclose(
        poses_along(way, start, end, np.arange(1, 5) / 4), poses_between(start, end, 4), atol=1e-12
    )


def test_it_is_found_by_its_name_and_refuses_options_out_of_range():
    env = gym.make("MSActiveSLAM-Room-v0", scene="table", image_size="80x60").unwrapped
    planner = make_planner("next-best-path,compared=3", env, 0)
    assert isinstance(planner.planner, NextBestPath)
    with pytest.raises(InputError, match=r"compared.*0"):
        make_planner("next-best-path,compared=0", env, 0)
