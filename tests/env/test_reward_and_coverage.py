"""Reward terms and coverage against closed forms."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ms_slam_env
from ms_slam_env.camera import pinhole
from ms_slam_env.env.coverage import CoverageGrid, Voxels
from ms_slam_env.env.env_config import EnvConfig, RewardConfig, TargetConfig
from ms_slam_env.env.make import options_for
from ms_slam_env.env.planners import make_planner
from ms_slam_env.env.reward import Outcome, reward_terms
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import make_pose, so3_exp, transform_points
from ms_slam_env.gym_ids import MAX_EPISODE_STEPS
from ms_slam_env.tasks import room

FREE = "MSActiveSLAM-FreeCamera-v0"

WEIGHTS = RewardConfig()
MAPPING = RewardConfig.named()["mapping"]
TARGETS = TargetConfig(M_I=0.02, M_D=0.04, rho_I=0.5, rho_D=0.25, depth_weight=3.0)
ON_TARGET = Outcome(
    divergence=np.array([0.01, 0.01]),
    pose_error_growth_m=0.0,
    ate_growth_m=0.0,
    new_surface_m2=0.0,
    tracking_ok=True,
    lost_for_good=False,
    blocked=False,
)


def test_all_terms_are_zero_on_target():
    on_target = dataclasses.replace(ON_TARGET, configuration_cost=0.0)
    own = lambda outcome: {"mine": -0.0}  # noqa: E731
    for weights in (WEIGHTS, own):
        terms = reward_terms(on_target, weights, TARGETS)
        assert {str(value) for value in terms.values()} == {"0.0"}  # and none is -0.0


@given(st.floats(0, 0.05), st.floats(0, 0.09))
def test_divergence_terms_are_the_summands_of_line_9(delta_I, delta_D):
    outcome = dataclasses.replace(ON_TARGET, divergence=np.array([delta_I, delta_D]))
    terms = reward_terms(outcome, WEIGHTS, TARGETS)
    assert terms["intensity_divergence"] == pytest.approx(
        -WEIGHTS.intensity_divergence * min(0.4, abs(delta_I - 0.01) / 0.02)
    )
    assert terms["depth_divergence"] == pytest.approx(
        -WEIGHTS.depth_divergence * 3 * min(0.4, abs(delta_D - 0.01) / 0.04)
    )


@pytest.mark.parametrize(
    ("change", "term", "sign", "weights"),
    [
        ({"ate_growth_m": 0.01}, "ate_growth", -1, WEIGHTS),
        ({"ate_growth_m": -0.01}, "ate_growth", 1, WEIGHTS),
        ({"pose_error_growth_m": 0.01}, "trajectory_error", -1, MAPPING),
        ({"pose_error_growth_m": -0.01}, "trajectory_error", 1, MAPPING),
        ({"new_surface_m2": 0.5}, "new_surface", 1, MAPPING),
        ({"tracking_ok": False}, "lost", -1, WEIGHTS),
        ({"lost_for_good": True}, "lost_for_good", -1, WEIGHTS),
        ({"blocked": True}, "blocked", -1, WEIGHTS),
    ],
)
def test_each_outcome_moves_its_own_term(change, term, sign, weights):
    terms = reward_terms(dataclasses.replace(ON_TARGET, **change), weights, TARGETS)
    assert np.sign(terms.pop(term)) == sign
    assert set(terms.values()) == {0.0}


def test_the_papers_reward_is_divergence_and_trajectory_error_alone():
    weights = EnvConfig(reward="paper").reward
    assert weights == RewardConfig.named()["paper"]
    bad = dataclasses.replace(
        ON_TARGET,
        divergence=np.array([0.03, 0.03]),
        pose_error_growth_m=0.02,
        ate_growth_m=0.02,
        new_surface_m2=3.0,
        tracking_ok=False,
        lost_for_good=True,
        blocked=True,
        configuration_cost=1.0,
    )
    terms = reward_terms(bad, weights, TARGETS)
    usual = reward_terms(bad, MAPPING, TARGETS)
    asked = {"intensity_divergence", "depth_divergence", "trajectory_error"}
    assert {name for name, value in terms.items() if value} == asked
    assert all(terms[name] == usual[name] != 0 for name in asked)
    assert EnvConfig(reward="default").reward == EnvConfig().reward == WEIGHTS
    for wrong in ("papers", {"name": "papers"}):
        with pytest.raises(InputError, match=r"unknown reward.* 'papers'; valid choices: .*paper"):
            EnvConfig(reward=wrong)


def test_environments_ask_for_divergence_and_error_and_tasks_for_a_map():
    def weights(env_id, **options):
        return gym.make(env_id, **options).unwrapped.config.reward

    for env_id in (*ms_slam_env.ENV_IDS, *ms_slam_env.PERTURBED_ENV_IDS):
        for chosen in ({}, {"reward": "default"}, {"reward": "divergence-and-error"}):
            assert weights(env_id, **chosen) == WEIGHTS
    for env_id in ms_slam_env.TASK_IDS:
        for chosen in ({}, {"reward": "default"}, {"reward": "mapping"}):
            assert weights(env_id, **chosen) == MAPPING
        assert weights(env_id, reward="divergence-and-error") == WEIGHTS
    assert weights(FREE, task="room") == MAPPING
    assert RewardConfig(0.5, 0.5, 0.0, 10.0, 1.0, 0.5, 10.0, 0.1, 0.1) == MAPPING  # as in records


@pytest.mark.parametrize(("env_id", "own"), [(FREE, WEIGHTS), ("MSActiveSLAM-Room-v0", MAPPING)])
def test_weights_without_a_name_change_the_environments_own(env_id, own):
    for chosen, expected in (
        ({"lost": 2.0}, dataclasses.replace(own, lost=2.0)),
        ({"name": "paper", "lost": 2.0}, RewardConfig(0.5, 0.5, 0, 10, 0, 2.0, 0, 0, 0)),
    ):
        assert gym.make(env_id, reward=chosen).unwrapped.config.reward == expected


def test_a_task_can_have_a_reward_of_its_own():
    task = dataclasses.replace(room(), options={"reward": {"new_surface": 3.0, "lost": 1.0}})
    options = options_for(task, {"reward": {"lost": 2.0}})
    assert EnvConfig(reward=options["reward"]).reward == RewardConfig(new_surface=3.0, lost=2.0)
    paper = dataclasses.replace(room(), options={"reward": "paper"})
    assert options_for(paper, {})["reward"] == "paper"
    assert options_for(paper, {"reward": "mapping"})["reward"] == "mapping"


@pytest.mark.parametrize(
    ("env_id", "options"), [(FREE, {"step_m": 0.3}), ("MSActiveSLAM-v0", {"pose": "kinematics"})]
)
def test_the_error_terms_of_an_episode_sum_to_its_final_ate(env_id, options):
    """A camera that gets lost, and an arm whose every step has several frames."""
    env = gym.make(env_id, scene_seed=1000, image_size="80x60", lost_patience=5, **options)
    _, info = env.reset(seed=1)
    total, rng = 0.0, np.random.default_rng(0)
    for _ in range(12):
        *_, terminated, _, info = env.step(rng.choice(np.flatnonzero(info["action_mask"])))
        total += info["reward_terms"]["ate_growth"]
        if terminated:
            break
    errors = [frame.pose_error for frame in env.unwrapped.episode.frames]
    assert len(errors) > (60 if env_id == "MSActiveSLAM-v0" else 5)
    assert info["ate"] > 1e-4
    assert info["ate"] == pytest.approx(np.sqrt(np.mean(np.square(errors))))
    assert total == pytest.approx(-WEIGHTS.ate_growth * info["ate"], rel=1e-9)


def test_getting_lost_costs_more_than_it_saves():
    """The largest distances of the steps that the end of a default episode saves."""
    farthest = dataclasses.replace(ON_TARGET, divergence=np.array([9.0, 9.0]))
    saved = -sum(reward_terms(farthest, WEIGHTS, TargetConfig()).values())
    assert 0 < saved < WEIGHTS.lost
    patience = EnvConfig().lost_patience
    assert WEIGHTS.lost_for_good + patience * WEIGHTS.lost > MAX_EPISODE_STEPS * saved


def test_standing_still_is_not_the_best_that_can_be_done():
    """Divergences at rest miss their targets by more than the error of a moving camera costs."""

    def earned(planner):
        env = gym.make(FREE, scene_seed=1000, max_episode_steps=40)
        observation, info = env.reset(seed=1000)
        chosen, total, over = make_planner(planner, env.unwrapped, 0), 0.0, False
        while not over:
            action = chosen.act(observation, info)
            observation, reward, terminated, truncated, info = env.step(action)
            total, over = total + reward, terminated or truncated
        return total

    assert earned("random") < earned("stationary") < earned("greedy") < 0


RAYS = pinhole("160x120").rays()
TOWARDS_WALL = make_pose(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (0.0, 0.0, 1.0))


def marked_one_by_one(scene, depth, true_depth, T, T_estimate):
    """Voxels of a frame's true surface that is mapped in its place, pixel by pixel."""
    voxels, marked = Voxels.of(scene, 0.05), set()
    for row in range(0, 120, 2):
        for column in range(0, 160, 2):
            if depth[row, column] > 0:
                point = RAYS[row, column] * true_depth[row, column]
                place = transform_points(T, point)
                cell = np.floor((place - voxels.origin) / 0.05).astype(int)
                off = np.linalg.norm(transform_points(T_estimate, point) - place)
                if off < 0.05 and (cell >= 0).all() and (cell < voxels.shape).all():
                    marked.add(tuple(cell.tolist()))
    return voxels, marked


def test_what_a_frame_marks_is_what_its_pixels_mark_one_by_one(box_scene):
    rng = np.random.default_rng(0)
    grid, marked = CoverageGrid(box_scene, RAYS), set()
    for _ in range(3):
        T = TOWARDS_WALL @ make_pose(so3_exp(rng.normal(size=3) * 0.3), rng.normal(size=3) * 0.3)
        T_estimate = T @ make_pose(so3_exp(rng.normal(size=3) * 0.02), (0.02, 0.0, 0.0))
        true_depth = rng.uniform(0.5, 4, (120, 160)).astype(np.float32)
        depth = np.where(rng.random((120, 160)) < 0.3, 0, true_depth).astype(np.float32)
        voxels, seen = marked_one_by_one(box_scene, depth, true_depth, T, T_estimate)
        new = len(seen - marked)
        marked |= seen
        assert new > 100
        assert grid.see(depth, true_depth, T, T_estimate) == new * 0.05**2
    assert grid.mapped_area == len(marked) * 0.05**2
    reachable = sum(voxels.reachable[np.ravel_multi_index(cell, voxels.shape)] for cell in marked)
    assert grid.mapped_share == reachable / voxels.num_reachable


def wall(grid, T_estimate=TOWARDS_WALL):
    """Show a wall 1 m ahead, 0.0025 m2 a voxel."""
    depth = np.ones((120, 160), np.float32)
    return grid.see(depth, depth, TOWARDS_WALL, T_estimate)


def test_area_of_a_wall_counts_once(box_scene):
    grid = CoverageGrid(box_scene, RAYS)
    width, height = np.ptp(RAYS[..., 0]), np.ptp(RAYS[..., 1])
    area = wall(grid)
    assert width * height < area < (width + 0.1) * (height + 0.1)  # voxels it only touches count
    assert wall(grid) == 0
    assert grid.mapped_area == pytest.approx(area)


def test_surface_mapped_in_the_wrong_place_does_not_count(box_scene):
    grid = CoverageGrid(box_scene, RAYS)
    assert wall(grid, TOWARDS_WALL @ make_pose(np.eye(3), (0.06, 0, 0))) == 0
    assert grid.mapped_area == grid.mapped_share == 0


def test_state_round_trip(box_scene):
    grid, twin = CoverageGrid(box_scene, RAYS), CoverageGrid(box_scene, RAYS)
    wall(grid)
    twin.set_state(grid.get_state())
    assert (twin.mapped_area, twin.mapped_share) == (grid.mapped_area, grid.mapped_share)
    assert twin.mapped_area > 0
    assert wall(twin) == 0


def test_a_camera_at_rest_is_not_paid_for_noise():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene_seed=1000, noise="kinect")
    _, info = env.reset(seed=0)
    at_start = info["mapped_area"]
    for _ in range(8):
        *_, info = env.step(0)
    assert at_start > 1.0
    # pixels at depth edges have a reading in one frame and none in the next: a little may come
    assert info["mapped_area"] < 1.05 * at_start
