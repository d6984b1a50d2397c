"""Training in the real environment with two processes, and its policy in an episode."""

import gymnasium as gym
import pytest

pytest.importorskip("sb3_contrib")

from ms_slam_agents import environments, train_sb3
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_planner import TrainedPolicy

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.errors import InputError


@pytest.mark.slow
def test_two_processes_train_a_policy_that_plans(tmp_path):
    options = {
        "out": tmp_path / "run",
        "scenes": "table",
        "scene-seeds": 1,
        "episode-steps": 4,
        "total-timesteps": 16,
        "num-envs": 2,
        "n-steps": 8,
        "batch-size": 8,
        "n-epochs": 1,
        "eval-episodes": 1,  # in this process: the two others train
        "eval-every": 0,
        "step-m": 0.1,
    }
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    assert train_sb3.main([*words, "--no-references"]) == 0
    path = tmp_path / "run" / "latest.safetensors"
    policy = Policy.load(path)
    assert (policy.metadata.timesteps, policy.metadata.epochs) == (16, 1)
    assert policy.metadata.env_options == {"step_m": 0.1}

    env = policy.make_env(scene="table", scene_seed=1000)
    assert env.unwrapped.config.step_m == 0.1
    planner = TrainedPolicy(env.unwrapped, path=str(path))  # before the first reset
    observation, info = env.reset(seed=0)
    for _ in range(3):
        action = planner.act(observation, info)
        assert info["action_mask"][action]
        observation, _, _, _, info = env.step(action)
    env.close()


def test_a_policy_with_the_defaults_fits_the_environment_with_the_defaults():
    """The observation of training is the one that an environment has if nobody says another."""
    args = train_sb3.Args(scenes=("table",), scene_seeds=1)
    trained_in = environments.make_env(args, "validation", ())
    for env_id in (args.env_id, "MSActiveSLAM-v0"):  # of the README
        env = gym.make(env_id, scene="table", scene_seed=1000)
        assert env.observation_space == trained_in.observation_space
        assert env.action_space == trained_in.action_space
        env.close()
    trained_in.close()


@pytest.mark.slow
def test_motion_and_slam_configuration_are_learnt_together(tmp_path):
    options = {
        "out": tmp_path / "run",
        "env-id": "MSActiveSLAM-Adaptive-v0",
        "embodiment": "free",
        "observation": "features",
        "scenes": "table",
        "scene-seeds": 1,
        "episode-steps": 4,
        "total-timesteps": 8,
        "num-envs": 1,
        "n-steps": 8,
        "batch-size": 8,
        "n-epochs": 1,
        "eval-episodes": 1,
        "eval-every": 0,
    }
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    assert train_sb3.main(words) == 0
    path = tmp_path / "run" / "latest.safetensors"
    env = gym.make(
        "MSActiveSLAM-Adaptive-v0",
        embodiment="free",
        scene="table",
        scene_seed=1000,
        observation="features",
    )
    planner = TrainedPolicy(env.unwrapped, path=str(path))
    observation, info = env.reset(seed=0)
    for _ in range(3):
        action = planner.act(observation, info)
        assert env.action_space.contains(action)
        assert info["action_mask"][[action[0], 49 + action[1]]].all()
        observation, _, _, _, info = env.step(action)
    with pytest.raises(InputError, match="chooses among 49 x 3 actions, the environment has 49"):
        TrainedPolicy(
            gym.make("MSActiveSLAM-FreeCamera-v0", scene="table", scene_seed=1000).unwrapped,
            path=str(path),
        )
