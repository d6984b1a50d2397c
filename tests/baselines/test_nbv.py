"""Next best view: its pieces against slow versions, its motions in a real episode."""

import math

import gymnasium as gym
import numpy as np
import pytest
from ms_slam_baselines.nbv import NextBestView
from ms_slam_baselines.view_goals import distance_in_steps, draw_goals

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose, relative_angle, so3_exp
from ms_slam_env.mapping import view_information

STEPS = 0.12, math.radians(12)


def play(seed, steps):
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene="living_room", scene_seed=3)
    observation, info = env.reset(seed=3)
    planner = NextBestView(env.unwrapped, seed)
    planner.reset()
    actions = []
    for _ in range(steps):
        action = planner.act(observation, info)
        assert info["action_mask"][action]
        observation, _, _, _, info = env.step(action)
        actions.append(action)
    return actions, info, planner


@pytest.fixture(scope="module")
def episode():
    return play(seed=0, steps=30)


def test_it_maps_much_without_losing_track(episode):
    actions, info, _ = episode
    assert info["tracking_ok"]
    assert info["ate"] < 0.02
    # Standing still maps 2 m2 here, a random walk of 30 steps 6 to 12 m2.
    assert info["mapped_area"] > 15
    assert len(set(actions)) > 5


def test_one_seed_one_episode(episode):
    again, info, _ = play(seed=0, steps=8)
    assert again == episode[0][:8]
    assert play(seed=1, steps=8)[0] != again
    assert info["tracking_ok"]


def test_admissible_motions_keep_overlap_information_and_distance(episode):
    planner = episode[2]
    env = planner.env
    poses = env.candidate_poses()
    found = planner.admissible(poses)
    views = env.slam.predict(poses, planner.scale)
    least = [np.linalg.eigvalsh(H).min() for H in view_information(views)]
    for n, possible in enumerate(env.action_masks()):
        filled = (views.depth[n] > 0).mean() >= min(planner.overlap, (views.depth[0] > 0).mean())
        shares = [((views.depth[i] > 0) & (views.depth[i] < 0.5)).mean() for i in (0, n)]
        apart = shares[1] <= max(0.1, shares[0])
        assert found[n] == (
            possible
            and filled
            and apart
            and least[n] >= min(150 * views.depth[0].size, 0.9 * least[0])
        )
    assert found.any()


def test_where_no_motion_can_be_followed_all_possible_ones_are_allowed(episode):
    planner = episode[2]
    poses = planner.env.candidate_poses()
    planner.lost_at = poses
    np.testing.assert_array_equal(planner.admissible(poses), planner.env.action_masks())


@pytest.mark.parametrize(
    "option", ["goals=0", "radius_m=-1", "replan=0", "overlap=1.5", "cell_m=.nan", "cost=much"]
)
def test_options_out_of_range_are_one_line(episode, option):
    name = option.partition("=")[0]
    with pytest.raises(InputError, match=rf"NextBestView\.{name} = .* is outside \["):
        make_planner(f"nbv,{option}", episode[2].env)


def test_distances_are_those_of_each_pose():
    rng = np.random.default_rng(0)
    goal = make_pose(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    poses = np.stack([make_pose(so3_exp(v[:3]), v[3:]) for v in rng.normal(size=(20, 6))])
    for found, pose in zip(distance_in_steps(poses, goal, *STEPS), poses, strict=True):
        metres = np.linalg.norm(pose[:3, 3] - goal[:3, 3])
        turn = relative_angle(pose[:3, :3], goal[:3, :3])
        np.testing.assert_allclose(found, [metres / STEPS[0], turn / STEPS[1]], atol=1e-6)


def test_goals_are_upright_poses_in_free_space():
    rng = np.random.default_rng(1)
    free = rng.uniform(-1, 1, (50, 3))
    here = make_pose(np.eye(3), [0.1, 0.2, 0.3])
    goals = draw_goals(rng, here, free, 90)
    assert len(goals) == 120
    for goal in goals:
        upright = look_at(goal[:3, 3], goal[:3, 3] + goal[:3, 2])
        np.testing.assert_allclose(goal, upright, atol=1e-9)
    assert (goals[:30, :3, 3] == here[:3, 3]).all()
    assert {tuple(p) for p in goals[30:, :3, 3]} <= {tuple(p) for p in free}
    assert len(draw_goals(rng, here, np.zeros((0, 3)), 90)) == 30
