"""The tasks: their ids, their options, and what ends an episode of theirs."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from ms_slam_env import ENV_IDS, TASK_IDS, scenes
from ms_slam_env.env.env_config import EnvConfig
from ms_slam_env.errors import InputError
from ms_slam_env.tasks import OWN, Task, env_id_of, find_task

SMALL = {"image_size": "80x60", "scene": "table", "scene_seed": 1}


def brief() -> Task:
    return Task(("table",), steps=3, options={"step_m": 0.05, "observation": "rgbd"})


def nothing() -> None:
    """Makes no task."""


@pytest.mark.parametrize("name", OWN)
def test_a_task_has_an_id_its_scenes_and_its_length(name):
    task = find_task(name)
    assert env_id_of(name) in TASK_IDS
    assert gym.spec(env_id_of(name)).max_episode_steps == task.steps
    env = gym.make(env_id_of(name), image_size="80x60").unwrapped
    assert env.config.scene == task.scenes
    assert type(env.simulation.embodiment_type) is type(
        gym.make(task.env_id).unwrapped.simulation.embodiment_type
    )
    assert len(env.camera_feed.perturbations) == len(task.perturbations)
    assert task.env_id in ENV_IDS
    for scene in task.scenes:
        assert scene in scenes.SCENES


def test_options_count_more_than_the_tasks_own():
    env = gym.make("MSActiveSLAM-Arm-v0", **SMALL, lost_patience=3, seconds=1.5).unwrapped
    config = env.config
    assert (config.scene, config.lost_patience, config.seconds) == ("table", 3, 1.5)
    assert config.away_patience == find_task("arm").options["away_patience"]


def test_the_tasks_slam_is_configured_unless_another_is_asked_for():
    name = "MSActiveSLAM-Home-v0"
    room = gym.make(name, **SMALL, slam_config={"submaps": "atlas"}).unwrapped.config.slam_config
    own = {**EnvConfig().slam_config, "max_surfels": 4_000_000, "unstable_window": 2000}
    assert room == {**own, "submaps": "atlas"}
    fewer = gym.make(name, **SMALL, slam_config={"max_surfels": 5000}).unwrapped.config.slam_config
    assert fewer == {**own, "max_surfels": 5000}
    assert gym.make(name, **SMALL, slam="odometry").unwrapped.config.slam_config == {}
    named = gym.make(name, **SMALL, slam="surfel,submaps=atlas").unwrapped.config.slam_config
    assert named == {"submaps": "atlas", "max_surfels": 4_000_000, "unstable_window": 2000}


def test_the_arms_task_ends_with_its_time():
    env = gym.make("MSActiveSLAM-Arm-v0", **SMALL, embodiment="arm-kinematic", seconds=0.5)
    env.reset(seed=0)
    times, over = [], False
    while not over:
        *_, terminated, over, info = env.step(0)
        assert not terminated
        times.append(info["time"])
    assert len(times) > 1
    assert times[-2] < 0.5 <= times[-1]


def test_disturbed_frames_are_blurred_and_show_what_moves():
    still = {**SMALL, "observation": "rgbd", "noise": "none"}
    plain, disturbed = (
        gym.make(id_, **still) for id_ in ("MSActiveSLAM-Room-v0", "MSActiveSLAM-Disturbed-v0")
    )
    frames = []
    for env in (plain, disturbed):
        env.reset(seed=3)
        frames.append(env.step(6)[0])  # yaw
    assert len(disturbed.unwrapped.camera_feed.movers) == 1
    difference = np.abs(frames[0]["color"].astype(int) - frames[1]["color"])
    assert difference.mean() > 1


def test_a_task_of_ones_own_is_found_by_module_and_function():
    name = f"{__name__}:brief"
    env = gym.make("MSActiveSLAM-FreeCamera-v0", task=name, image_size="80x60").unwrapped
    assert env.config.step_m == 0.05
    assert find_task(brief) == find_task(name) == brief()


def test_what_is_no_task_is_refused():
    with pytest.raises(InputError, match="unknown task 'rom'; valid choices: room, home, arm"):
        find_task("rom")
    with pytest.raises(InputError, match=r"made NoneType, no ms_slam_env.tasks.Task"):
        find_task(nothing)
    with pytest.raises(InputError, match="reference"):
        Task(("table",), reference="everything")
    with pytest.raises(InputError, match="steps"):
        Task(("table",), steps=0)
