"""The planners in the real environment: valid motions, the criterion met, reproducible."""

from dataclasses import replace
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from ms_slam_baselines import GreedyDivergence, MaxInformation, RandomWalk, Stationary
from ms_slam_baselines.greedy import PAPER_TARGETS

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.divergence import depth_divergence, intensity_divergence
from ms_slam_env.env.env_config import TargetConfig
from ms_slam_env.env.lookahead import Lookahead
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError

PLANNERS = (GreedyDivergence, MaxInformation, RandomWalk, Stationary)
IDS = ("MSActiveSLAM-FreeCamera-v0", "MSActiveSLAM-FixedTranslation-v0")


@pytest.fixture(scope="module", params=IDS)
def env(request):
    env = gym.make(request.param, scene_seed=1000)
    yield env
    env.close()


def play(env, planner_class, steps=4, seed=5):
    observation, info = env.reset(seed=seed)
    planner = planner_class(env.unwrapped, seed)
    planner.reset()
    actions = []
    for _ in range(steps):
        action = planner.act(observation, info)
        assert info["action_mask"][action]
        observation, _, _, _, info = env.step(action)
        actions.append(action)
    return actions


@pytest.mark.parametrize("planner_class", PLANNERS)
def test_motions_are_free_and_reproducible(env, planner_class):
    assert play(env, planner_class) == play(env, planner_class)


@pytest.mark.parametrize("name", ["nbv", "belief", "graph-dopt", "greedy-limited", "receding-nbv"])
def test_a_new_planner_needs_no_reset(env, name):
    observation, info = env.reset(seed=2)
    fresh, reset = (make_planner(name, env.unwrapped, seed=2) for _ in range(2))
    reset.reset()
    assert fresh.act(observation, info) == reset.act(observation, info)


def test_the_papers_greedy_is_algorithm_1_with_the_public_divergences(env):
    """Line by line, one candidate at a time, whatever the environment is configured to measure."""
    observation, info = env.reset(seed=1)
    observation, _, _, _, info = env.step(1)
    world = env.unwrapped
    planner = GreedyDivergence(world, preset="paper", depth_weight=0.5)
    live, targets = world.episode.last_frame, PAPER_TARGETS
    best, smallest = -1, np.inf
    views = world.slam.project(world.candidate_poses(), 1.0)
    for i in np.flatnonzero(info["action_mask"]):
        predicted_I = np.floor(views.intensity[i] + 0.5).astype(np.uint8)
        delta_I = intensity_divergence(predicted_I, live)
        delta_D = depth_divergence(views.depth[i], live.depth, world.intrinsics)
        distance = abs(delta_I - targets.M_I) + 0.5 * abs(delta_D - targets.M_D)
        if distance < smallest:
            best, smallest = i, distance
    assert planner.act(observation, info) == best
    assert planner.targets.M_I != world.config.targets.M_I


def test_an_exact_lookahead_projects_the_map_for_each_candidate(env):
    """Its divergences are those of views rendered one at a time; the default's differ."""
    env.reset(seed=1)
    env.step(1)
    world = env.unwrapped
    here, poses = world.episode.T_world_camera_estimate, world.candidate_poses()
    config = replace(world.config.lookahead, projection="exact")
    lookahead = Lookahead(config, world.config.divergence, world.intrinsics)
    found = lookahead.divergences(world.slam, poses, here, world.episode.last_frame)
    reference = world.slam.project(here[None], config.scale)
    measure = lookahead.measure
    for i in (0, 3, 6):
        one = world.slam.project(poses[i : i + 1], config.scale)
        both = [measure.histograms(v.intensity, v.depth, v.normals) for v in (one, reference)]
        np.testing.assert_allclose(found[i], measure.divergence(*both)[0], rtol=1e-6, atol=1e-9)
    assert not np.array_equal(found, world.lookahead())


def test_greedy_names_its_presets():
    env = SimpleNamespace(lookahead=None, config=SimpleNamespace(targets=TargetConfig()))
    with pytest.raises(InputError, match=r"preset of greedy 'icra'.*environment, paper"):
        GreedyDivergence(env, preset="icra")
    with pytest.raises(InputError, match="preset=environment only"):
        GreedyDivergence(env, preset="paper", calibration=0.3)


def test_greedy_with_targets_of_zero_stands_still():
    """With the map's own view as reference, only standing still has no divergence at all."""
    env = gym.make(IDS[0], scene_seed=1000, lookahead={"reference": "predicted"})
    observation, info = env.reset(seed=1)
    planner = GreedyDivergence(env.unwrapped, rho_I=0, rho_D=0)
    np.testing.assert_allclose(env.unwrapped.lookahead()[0], 0, atol=1e-9)
    assert planner.act(observation, info) == 0
