"""The oracle sees what the sensor sees, counts what is mapped, and knows better than `held-nbv`."""

import numpy as np
import pytest
from small_env import ROOM, small_env

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_truth import surface_nearby
from ms_slam_env.geometry import invert, transform_points


@pytest.fixture(scope="module")
def start():
    """An oracle after its first decision, the view from its start and the world."""
    env = small_env(ROOM, image_size="160x120")
    observation, info = env.reset(seed=0)
    planner = make_planner("oracle", env.unwrapped)
    planner.reset()
    action = planner.act(observation, info)
    return env, planner, action, observation, info


def test_it_sees_the_points_that_the_rendered_depth_shows(start):
    env, planner, *_ = start
    world, camera = env.unwrapped, env.unwrapped.intrinsics
    points = surface_nearby(world.scene, world.episode.frames[0].T_world_camera[:3, 3])
    here = world.episode.frames[0].T_world_camera
    depth = world.camera_feed.true_depth()
    local = transform_points(invert(here), points)
    pixel = np.round(camera.project(np.where(local[:, 2:] > 0, local, (9, 9, 1)))).astype(int)
    inside = (local[:, 2] > 0.3) & (local[:, 2] < 4.0)
    inside &= ((pixel >= 0) & (pixel < [camera.width, camera.height])).all(axis=1)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(depth, 1, mode="edge"), (3, 3))
    (u, v), z = pixel[inside].T, local[inside, 2]
    is_shown = np.abs(depth[v, u] - z) < 0.005 * z
    is_hidden = around.max(axis=(2, 3))[v, u] < 0.97 * z - 0.02
    left, planner.planner.left = planner.planner.left, points.astype(np.float32)
    seen = planner.planner._sees(here[None])[0]
    planner.planner.left = left
    assert min(is_shown.sum(), is_hidden.sum()) > 500
    assert seen[inside][is_shown].mean() > 0.95
    assert seen[inside][is_hidden].mean() < 0.01
    assert not seen[~inside].any()


def test_what_a_frame_has_mapped_is_not_left_and_what_is_left_it_goes_for(start):
    env, planner, action, observation, info = start
    oracle = planner.planner
    left = [len(oracle.left)]
    assert left[0] < oracle.total
    for _ in range(8):
        expected = oracle.values(env.unwrapped.episode.T_world_camera_estimate)
        assert expected.max() > 0.02
        observation, *_, info = env.step(action)
        action = planner.act(observation, info)
        left.append(len(oracle.left))
    mapped = -np.diff(left) / oracle.total
    assert (mapped >= 0).all()
    assert mapped.sum() > 0.05
    here = env.unwrapped.episode.frames[-1].T_world_camera
    assert oracle.gain_of(here[None])[0] < 0.01


def test_a_reference_that_there_is_not_is_refused(start):
    env = start[0]
    with pytest.raises(InputError, match="nearby, scene, arm"):
        make_planner("oracle,reference=moon", env.unwrapped)
    planner = make_planner("oracle,reference=arm", env.unwrapped)
    planner.reset()
    with pytest.raises(InputError, match="needs embodiment 'arm'"):
        planner.act(start[3], start[4])
