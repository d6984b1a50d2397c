"""Next best view: its pieces against slow versions, its motions in a real episode."""

import math
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ms_slam_baselines.nbv import NextBestView
from ms_slam_baselines.view_goals import frontiers, poses_between, views_anywhere, views_of

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.camera import xtion
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose, relative_angle, so3_exp
from ms_slam_env.planning import FREE, UNKNOWN, OccupancyGrid, shortest_ways
from ms_slam_env.planning.trackability import SCALE, image_motion, slip_risk
from ms_slam_env.planning.view_goals import distance_in_steps
from ms_slam_env.slam.slam_backend import Views

STEPS = 0.12, math.radians(12)


def play(seed, steps, **options):
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene="living_room", scene_seed=3, **options)
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


def test_what_a_motion_risks_is_what_its_frames_do():
    """One that an arm makes in a dozen frames risks less than in one."""
    env = gym.make("MSActiveSLAM-Arm-v0", scene="table", scene_seed=3, embodiment="arm-kinematic")
    env.reset(seed=3)
    planner = NextBestView(env.unwrapped)
    assert planner.frames == env.unwrapped.embodiment.frames_per_motion > 5
    poses, possible = env.unwrapped.candidate_poses(), env.unwrapped.action_masks()
    risks = planner.risks(poses, possible)
    with patch.object(NextBestView, "frames", 1):
        at_once = planner.risks(poses, possible)
    moves = possible & np.isfinite(at_once)
    moves[0] = False  # to stay
    assert moves.sum() > 10
    assert (risks[moves] < at_once[moves]).all()
    assert np.median(risks[moves] / at_once[moves]) < 0.5


def test_frames_of_a_free_camera_are_those_that_it_was_given():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene="table", scene_seed=3, frames_per_action=3)
    env.reset(seed=3)
    assert NextBestView(env.unwrapped).frames == 3


def test_one_seed_one_episode(episode):
    again, info, _ = play(seed=0, steps=8)
    assert again == episode[0][:8]
    assert play(seed=1, steps=8)[0] != again
    assert info["tracking_ok"]


def test_admissible_motions_keep_overlap_and_distance_and_do_not_risk_much(episode):
    planner = episode[2]
    env = planner.robot
    poses = env.candidate_poses()
    found = planner.admissible(poses)
    here = env.T_world_camera_estimate
    seen_from = np.concatenate([here[None], poses])
    views = env.predict(seen_from, SCALE)
    shares = [((view > 0) & (view < 0.5)).mean() for view in views.depth]
    filled = [(view > 0).mean() for view in views.depth]
    fits = [
        filled[n] >= min(planner.overlap, filled[0]) and shares[n] <= max(0.1, shares[0])
        for n in range(len(seen_from))
    ]
    risks = slip_risk(views, seen_from)
    rolls = (1, 2)
    others = [n for n in range(1, 49) if n not in rolls and env.action_masks()[n] and fits[n + 1]]
    least = min(risks[n + 1] for n in others)
    for n in range(49):
        assert found[n] == (n in others and risks[n + 1] <= max(planner.risk, 1.3 * least))
    assert found.any()


def test_where_no_motion_can_be_followed_all_possible_ones_are_allowed(episode):
    planner = episode[2]
    poses = planner.robot.candidate_poses()
    before, planner.lost_at = planner.lost_at, poses
    np.testing.assert_array_equal(planner.admissible(poses), planner.robot.action_masks())
    planner.lost_at = before


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.05, 0.3, 1.0]), st.sampled_from([0, 3]))
def test_looking_at_the_best_first_leads_to_the_same_motion(episode, seed, scale, given_up):
    planner, rng = episode[2], np.random.default_rng(seed)
    poses = planner.robot.candidate_poses()
    score = rng.normal(size=len(poses)).round(1)
    table = np.where(rng.random(len(poses)) < 0.5, scale * rng.random(len(poses)), np.inf)
    asked = []

    def risks(some, permitted):
        rows = [int(np.flatnonzero((poses == pose).all(axis=(1, 2)))[0]) for pose in some]
        asked.append(len(rows))
        return np.where(permitted, table[rows], np.inf)

    with patch.object(planner, "risks", risks), patch.object(planner, "given_up", given_up):
        found = planner.admissible(poses, np.argsort(-score, kind="stable"))
        of_all = planner.admissible(poses)
    assert asked.pop() == len(poses)
    assert max(asked) <= 6
    best, best_of_all = (np.argmax(np.where(can, score, -np.inf)) for can in (found, of_all))
    assert best == best_of_all


def test_of_motions_far_apart_only_the_best_are_predicted():
    planner = play(0, 2, step_m=0.3, step_rad=math.radians(24))[2]
    slam, here = planner.robot, planner.robot.T_world_camera_estimate
    with patch.object(slam, "predict", wraps=slam.predict) as predict:
        planner.motion_towards(here)
    assert {len(call.args[0]) for call in predict.call_args_list} == {7}
    assert predict.call_count < 8


def test_where_tracking_was_lost_it_does_not_go_again(episode):
    planner = episode[2]
    poses = planner.robot.candidate_poses()
    planner.heading_to = poses[3]
    planner.lost_by(3)
    assert planner.goal is None
    assert not planner.admissible(poses)[3]
    planner.instead(1)  # of what it chose
    planner.lost_by(1)
    np.testing.assert_array_equal(planner.lost_at[-2:], poses[[3, 1]])
    planner.lost_at = planner.lost_at[:-2]


def wall(distance, poses):
    """What cameras at poses see of the plane z = ``distance``, at 40 x 30 pixels."""
    K = xtion("160x120").scaled(0.25)
    directions = np.einsum("nij,vuj->nvui", poses[:, :3, :3], K.rays())
    depth = (distance - poses[:, 2, 3])[:, None, None] / directions[..., 2]
    normals = np.broadcast_to(-poses[:, 2, :3][:, None, None], (*depth.shape, 3))
    images = (0 * depth, depth, normals)
    return Views(*(np.ascontiguousarray(i, dtype=np.float32) for i in images), K)


def test_the_image_moves_by_the_turn_and_by_the_parallax():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1, :3, :3] = so3_exp([0, 0.2, 0])
    poses[2, 0, 3] = 0.12
    poses[3, 0, 3], poses[3, :3, :3] = 0.12, so3_exp([0, -math.atan(0.12 / 1.5), 0])
    moved = image_motion(wall(1.5, poses), poses)
    assert moved[0] == pytest.approx(0, abs=1e-3)
    assert moved[1] == pytest.approx(0.2, rel=0.05)
    assert moved[2] == pytest.approx(math.atan(0.12 / 1.5), rel=0.1)
    assert moved[3] < 0.2 * moved[2]  # turned to the same point again
    nothing = wall(1.5, poses)
    nothing.depth[0] = 0
    assert (image_motion(nothing, poses) == np.pi).all()


def test_to_slip_is_likelier_near_a_wall_and_by_large_motions():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 0, 3], poses[2, 0, 3] = 0.05, 0.3
    near, far = (slip_risk(wall(distance, poses), poses) for distance in (0.6, 2.5))
    assert near[0] < near[1] < near[2]
    assert (far < near).all()
    corner = wall(2.5, poses)
    half = corner.normals.shape[2] // 2
    corner.normals[:, :, :half] = [0.7, 0, -0.7]
    corner.normals[:, :10] = [0, 0.7, -0.7]
    assert (slip_risk(corner, poses) < 0.5 * far).all()


@pytest.mark.parametrize(
    "option", ["goals=0", "radius_m=-1", "replan=0", "overlap=1.5", "cell_m=.nan", "reach_m=0"]
)
def test_options_out_of_range_are_one_line(episode, option):
    name = option.partition("=")[0]
    with pytest.raises(InputError, match=rf"NextBestView\.{name} = .* is outside \["):
        make_planner(f"nbv,{option}", episode[2].robot)


@pytest.mark.parametrize(
    "planner",
    ["nbv,goals=10.5", "held-nbv,horizon=2.5", "oracle,points=9.5", "foresight,tried=3.5"],
)
def test_what_is_counted_takes_no_fractions(episode, planner):
    with pytest.raises(InputError, match=r"\.5 must be an integer"):
        make_planner(planner, episode[2].robot._env)


def test_steps_of_no_length_are_no_division_by_it():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene="table", image_size="80x60", step_rad=0.0)
    observation, info = env.reset(seed=0)
    planner = make_planner("nbv", env.unwrapped)
    planner.reset()
    with np.errstate(all="raise", under="ignore"):
        for _ in range(3):
            observation, *_, info = env.step(planner.act(observation, info))


def test_options_of_its_goals_are_known_and_others_are_refused(episode):
    env = episode[2].robot
    assert make_planner("nbv,recovery=false,replan=3,risk=0.1", env).replan == 3
    with pytest.raises(InputError, match=r"unknown option of planner nbv 'rish'.*risk.*radius_m"):
        make_planner("nbv,rish=0.1", env)


def test_distances_are_those_of_each_pose():
    rng = np.random.default_rng(0)
    goal = make_pose(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    poses = np.stack([make_pose(so3_exp(v[:3]), v[3:]) for v in rng.normal(size=(20, 6))])
    for found, pose in zip(distance_in_steps(poses, goal, *STEPS), poses, strict=True):
        metres = np.linalg.norm(pose[:3, 3] - goal[:3, 3])
        turn = relative_angle(pose[:3, :3], goal[:3, :3])
        np.testing.assert_allclose(found, [metres / STEPS[0], turn / STEPS[1]], atol=1e-6)


def test_goals_are_upright_poses_where_the_camera_can_come_to(episode):
    planner = episode[2]
    here = planner.robot.T_world_camera_estimate
    goals, worth = planner.drawn_goals(here)
    assert len(goals) == len(worth) == planner.goals + planner.goals // 3
    for goal in goals:
        upright = look_at(goal[:3, 3], goal[:3, 3] + goal[:3, 2])
        np.testing.assert_allclose(goal, upright, atol=1e-9)
    in_place = planner.goals // 3
    assert (goals[:in_place, :3, 3] == here[:3, 3]).all()
    known = {tuple(p) for p in planner.ways.positions}
    assert {tuple(p) for p in goals[in_place:, :3, 3]} <= known
    assert views_anywhere(np.random.default_rng(0), np.zeros((0, 3))).shape == (0, 4, 4)


def two_rooms():
    """Known free space of 4 x 2 x 2 m, a wall in the middle with a door at its end."""
    grid = OccupancyGrid()
    grid.first = np.zeros(3, dtype=np.int64)
    grid.log_odds = np.full((40, 20, 20), -1, dtype=np.int8)
    grid.log_odds[20, :14] = 3
    grid.blanks = np.zeros_like(grid.log_odds)
    return grid


def test_the_way_to_a_goal_behind_a_wall_leads_through_the_door(episode):
    planner = episode[2]
    kept = planner.map.grid, planner.ways, planner.way, planner.goal
    planner.map.grid = two_rooms()
    R = look_at([0, 0, 0], [1, 0, 0])[:3, :3]
    here, planner.goal = make_pose(R, [1.55, 0.55, 1.05]), make_pose(R, [2.55, 0.55, 1.05])
    planner.ways = shortest_ways(planner.map.grid, here[:3, 3], 3.0)
    nearest = np.linalg.norm(planner.ways.positions - planner.goal[:3, 3], axis=1).argmin()
    planner.way = planner.ways.to(int(nearest))
    assert planner.steps_to_goal(here) > 1.8 / STEPS[0]  # 1 m as the crow flies
    first = planner.next_on_way(here)
    assert first[1, 3] > here[1, 3] + 0.3  # along the wall
    assert first[0, 3] < 2.0
    np.testing.assert_array_equal(planner.next_on_way(make_pose(R, [2.55, 0.9, 1])), planner.goal)
    planner.map.grid, planner.ways, planner.way, planner.goal = kept


def test_a_goal_that_comes_no_nearer_is_given_up_and_more_is_risked(episode):
    planner = episode[2]
    here = planner.robot.T_world_camera_estimate
    planner.goal, planner.way = make_pose(here[:3, :3], here[:3, 3] + 1.0), here[None, :3, 3]
    planner.begun, planner.age, planner.given_up = planner.steps_to_goal(here), 0, 0
    planner.judge_goal(here)
    assert planner.goal is not None
    planner.age, goal = planner.replan, planner.goal
    planner.judge_goal(here)
    assert planner.goal is None
    assert planner.given_up == 1
    assert not planner.is_new(goal[None], here).any()
    poses, risk = planner.robot.candidate_poses(), planner.risk
    planner.risk = 1e-6
    few = planner.admissible(poses)
    planner.given_up = 20
    more = planner.admissible(poses)
    planner.given_up, planner.risk = 0, risk
    assert (more >= few).all()
    assert more.sum() > few.sum()


def test_nothing_is_known_beyond_the_reach(episode):
    planner, grids = episode[2], []
    here = planner.robot.T_world_camera_estimate
    depth = np.full_like(planner.robot.last_frame.depth, 3.0)
    for reach in (2.0, 3.5):
        near = NextBestView(planner.robot, reach_m=reach)
        near.map.add(planner.robot, depth, here, planner.robot.intrinsics)
        grids.append(near.map.grid)
    at = (here @ [[0, 0], [0, 0], [1.5, 2.5], [1, 1]])[:3].T
    assert grids[0].states_of(at).tolist() == [FREE, UNKNOWN]
    assert grids[1].states_of(at).tolist() == [FREE, FREE]


def test_the_way_to_a_pose_is_straight_and_even():
    start = make_pose(so3_exp([0.1, 0.2, -0.3]), [1, 2, 3])
    end = make_pose(so3_exp([-0.4, 1.1, 0.2]), [0, 2.5, 3])
    way = poses_between(start, end, 4)
    np.testing.assert_allclose(way[-1], end, atol=1e-9)
    whole = relative_angle(start[:3, :3], end[:3, :3])
    for n, pose in enumerate(way, 1):
        np.testing.assert_allclose(pose[:3, 3], start[:3, 3] + n / 4 * (end - start)[:3, 3])
        assert relative_angle(start[:3, :3], pose[:3, :3]) == pytest.approx(n / 4 * whole)


def seen_from_origin():
    grid = OccupancyGrid()
    K = xtion("80x60")
    grid.integrate(np.full(K.shape, 2.0, np.float32), np.eye(4), K)
    return grid


def test_frontiers_are_where_free_space_ends_unseen():
    grid = seen_from_origin()
    middles = frontiers(grid, np.zeros(3), 2.5, least=1)
    assert len(middles)
    steps = grid.cell_m * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
    for middle in middles:
        assert grid.states_of(middle[None]) == [FREE]
        around = grid.states_of(middle + np.concatenate([steps, -steps[-1:]]))
        assert (around == UNKNOWN).any()
    assert frontiers(OccupancyGrid(), np.zeros(3), 2.5).shape == (0, 3)
    assert frontiers(grid, np.full(3, 50.0), 2.5).shape == (0, 3)


def test_frontiers_are_looked_at_from_free_space_and_not_from_below():
    free = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0.2], [2, 0, -3.0]])
    (view,) = views_of(np.array([[2.0, 0, 0]]), free, np.zeros(3), 1.0)
    np.testing.assert_allclose(view[:3, 3], [1, 0, 0])
    np.testing.assert_allclose(view[:3, 2], [1, 0, 0], atol=1e-12)
    assert views_of(np.array([[2.0, 0, 0]]), free[3:], np.zeros(3), 1.0).shape == (0, 4, 4)
