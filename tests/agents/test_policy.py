"""A policy in NumPy acts as its network does in PyTorch, in an environment that fits it."""

import math
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import torch
from learnable_fake import ENV_ID, NUM_ACTIONS, LearnableFake, fake_env, with_moments
from ms_slam_agents import policy as policy_module
from ms_slam_agents.network import Network
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import Metadata, PolicyFile, read_policy, write_policy
from ms_slam_agents.policy_planner import RoomAgent, TrainedPolicy
from ms_slam_agents.sb3_state import ALGORITHMS, restore, tensors_of
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from ms_slam_env.env.planners import make_planner, planner_observation
from ms_slam_env.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ROOT / "agents" / "policies" / "room.safetensors"


def make_model(algorithm, seed=0):
    venv = VecNormalize(DummyVecEnv([lambda: gym.make(ENV_ID)]))
    options = {"n_steps": 32, "batch_size": 16, "learning_rate": 0.01}
    options |= {"policy_kwargs": {"net_arch": [16, 16]}}
    return ALGORITHMS[algorithm]("MlpPolicy", venv, seed=seed, device="cpu", **options)


def file_of(model, algorithm="ppo", **changes):
    metadata = {
        "algorithm": algorithm,
        "env_id": ENV_ID,
        "observation": "features",
        "inputs": NUM_ACTIONS,
        "hidden": (16, 16),
        "actions": (NUM_ACTIONS,),
        "timesteps": model.num_timesteps,
        "epochs": model._n_updates,
        "minutes": 0.0,
    }
    return PolicyFile(Metadata(**metadata | changes), tensors_of(model))


@pytest.fixture(scope="module", params=["maskable_ppo", "ppo"])
def trained(request, tmp_path_factory):
    model = make_model(request.param).learn(128)
    path = tmp_path_factory.mktemp(request.param) / "policy.safetensors"
    write_policy(path, file_of(model, request.param))
    return model, path


def test_numpy_agrees_with_stable_baselines3(trained):
    model, path = trained
    observations = np.random.default_rng(0).normal(3, 4, (200, NUM_ACTIONS))
    scaled = model.get_vec_normalize_env().normalize_obs(observations.astype(np.float32))
    with torch.no_grad():
        distribution = model.policy.get_distribution(torch.as_tensor(scaled, dtype=torch.float32))
    found = Policy.load(path).probabilities(
        observations.astype(np.float32), np.ones((200, NUM_ACTIONS), dtype=bool)
    )
    expected = distribution.distribution.probs.numpy()
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.ptp(expected, axis=0).max() > 0.05  # not just uniform


@pytest.mark.parametrize("name", ["room", "paper"])
def test_a_shipped_policy_agrees_with_pytorch(name):
    path = SHIPPED.with_stem(name)
    file, policy = read_policy(path), Policy.load(path)
    known, rng = policy.metadata, np.random.default_rng(1)
    moments = file.part("observation")
    observations = rng.normal(moments["mean"], np.sqrt(moments["var"]), (500, known.inputs))
    scaled = np.clip((observations - moments["mean"]) / np.sqrt(moments["var"] + 1e-8), -10, 10)
    masks = rng.random((500, policy.num_actions)) < 0.7
    masks[:, 0] = True
    network = Network(known.inputs, known.hidden[0], policy.num_actions, 0, known.candidates)
    network.load_state_dict({k: torch.from_numpy(v) for k, v in file.part("policy").items()})
    with torch.no_grad():
        seen = torch.as_tensor(scaled, dtype=torch.float32)
        expected = network(seen, torch.zeros(500, 0), torch.as_tensor(masks))[0].exp().numpy()
    np.testing.assert_allclose(policy.probabilities(observations, masks), expected, atol=1e-5)
    assert np.ptp(expected, axis=0).max() > 0.05  # not just uniform


@pytest.mark.parametrize("memory", [0, 8])
@pytest.mark.parametrize("sees", [{}, {"candidates": 3}, {"image": (2, 17, 22)}], ids=str)
def test_numpy_is_the_network_of_our_own_and_is_read_back(sees, memory, tmp_path):
    inputs = 4 + NUM_ACTIONS * sees.get("candidates", 0) + math.prod(sees.get("image", (0,)))
    torch.manual_seed(0)
    network = Network(inputs, 16, NUM_ACTIONS, memory, **sees)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0, 0.3 if "image" in sees else 0.5)
    shape = ("masked_ppo", ENV_ID, "features", inputs, (16, 16), (NUM_ACTIONS,), 1, 1, 0.0)
    metadata = Metadata(*shape, memory=memory, **sees)
    write_policy(tmp_path / "policy.safetensors", with_moments(network, metadata))
    policy = Policy.load(tmp_path / "policy.safetensors")
    assert policy.metadata == metadata
    rng = np.random.default_rng(0)
    own, theirs = policy.empty_memory(4), torch.zeros(4, memory)
    for _ in range(4):
        seen, masks = rng.normal(size=(4, inputs)), rng.random((4, NUM_ACTIONS)) < 0.6
        masks[:, 0] = True
        own = policy.remember(seen, own)
        scaled = torch.as_tensor((seen - 0.5) / 2, dtype=torch.float32)
        with torch.no_grad():
            theirs = network.remember(scaled, theirs, torch.zeros(4))
            expected = network(scaled, theirs, torch.as_tensor(masks))[0].exp().numpy()
        np.testing.assert_allclose(policy.probabilities(seen, masks, own), expected, atol=1e-5)
    assert expected.max() > 1.5 / NUM_ACTIONS


def test_a_mask_takes_its_share_from_the_others(trained):
    policy = Policy.load(trained[1])
    observations = np.random.default_rng(2).normal(3, 4, (20, NUM_ACTIONS))
    masks = np.random.default_rng(3).random((20, NUM_ACTIONS)) < 0.5
    masks[:, 0] = True
    all_of_them = policy.probabilities(observations, np.ones_like(masks))
    expected = all_of_them * masks / (all_of_them * masks).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(policy.probabilities(observations, masks), expected)


def test_a_restored_model_has_every_number_of_the_old_one(trained):
    model, path = trained
    other = make_model("maskable_ppo" if "maskable" in str(path) else "ppo", seed=5)
    restore(other, read_policy(path))
    assert (other.num_timesteps, other._n_updates) == (model.num_timesteps, model._n_updates)
    expected, found = tensors_of(model), tensors_of(other)
    assert expected.keys() == found.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)


def test_the_planner_draws_by_its_seed_and_respects_the_mask(trained):
    observations = np.random.default_rng(1).normal(3, 4, (60, NUM_ACTIONS)).astype(np.float32)

    def actions(seed, **options):
        env = fake_env(seed=3)
        planner = TrainedPolicy(env, seed, path=str(trained[1]), **options)
        drawn = [planner.act(observation, {}) for observation in observations]
        assert all(env.mask[action] for action in drawn)
        return drawn

    assert actions(5) == actions(5)
    assert actions(5) != actions(6)
    assert actions(5, deterministic="true") == actions(6, deterministic=True)


def test_the_planner_refuses_what_it_cannot_run(trained, tmp_path, monkeypatch):
    path = str(trained[1])
    monkeypatch.delenv("MS_SLAM_POLICY", raising=False)
    with pytest.raises(InputError, match="MS_SLAM_POLICY"):
        TrainedPolicy(fake_env())
    with pytest.raises(InputError, match="no policy file"):
        TrainedPolicy(fake_env(), path=str(tmp_path / "none"))
    with pytest.raises(InputError, match="7 actions, the environment has 49"):
        TrainedPolicy(fake_env(49), path=path)
    with pytest.raises(InputError, match=r"'features', 7 numbers; .* have shape \(9,\)"):
        TrainedPolicy(fake_env(inputs=9), path=path)
    with pytest.raises(InputError, match="true, false"):
        TrainedPolicy(fake_env(), path=path, deterministic="maybe")
    write_policy(tmp_path / "fresh", file_of(make_model("ppo")).without_optimizer())
    with pytest.raises(InputError, match="is untrained"):
        TrainedPolicy(fake_env(), path=str(tmp_path / "fresh"))
    monkeypatch.setenv("MS_SLAM_POLICY", path)
    assert TrainedPolicy(fake_env()).policy.num_actions == NUM_ACTIONS


def test_a_planner_is_shown_what_its_policy_was_trained_on(trained, monkeypatch):
    monkeypatch.delenv("MS_SLAM_POLICY", raising=False)
    assert planner_observation(f"policy,path={trained[1]},deterministic=true") == "features"
    assert RoomAgent.observation_for(deterministic=True) == "held"
    assert planner_observation("agent-paper") == "candidates"
    assert planner_observation("greedy,recovery=true") == "features"
    with pytest.raises(InputError, match="MS_SLAM_POLICY"):
        planner_observation("policy")
    with pytest.raises(InputError, match="no policy file 'none'"):
        planner_observation("policy,path=none")


def test_the_policy_makes_the_environment_that_fits(trained):
    policy = Policy.load(trained[1])
    env = policy.make_env(max_episode_steps=5)
    assert isinstance(env.unwrapped, LearnableFake)
    observation, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = policy.act(observation, env.unwrapped.action_masks(), rng)
        observation, _, _, truncated, _ = env.step(action)
    assert truncated
    missing = Policy(file_of(trained[0], env_id="MSActiveSLAM-v9"))
    with pytest.raises(InputError, match="unknown environment 'MSActiveSLAM-v9'; valid choices"):
        missing.make_env()


def test_observations_of_another_environment_are_refused():
    policy = Policy.load(SHIPPED)
    with pytest.raises(InputError, match=r"\(287,\).*|observations of shape \(1, 287\).*'held'"):
        policy.act(np.zeros(287), np.ones(49, dtype=bool))
    with pytest.raises(InputError, match=r"masks of shape \(1, 7\)"):
        policy.act(np.zeros(1315), np.ones(7, dtype=bool))


@pytest.mark.parametrize("env_id", ["MSActiveSLAM-Room-v0", "MSActiveSLAM-Arm-v0"])
def test_the_agent_of_ppo_moves_a_free_camera_and_the_arm(env_id):
    seen = planner_observation("agent-ppo")
    env = gym.make(env_id, scene="table", scene_seed=3, observation=seen)
    observation, info = env.reset(seed=3)
    planner = make_planner("agent-ppo", env.unwrapped)
    planner.reset()
    for _ in range(2):
        action = planner.act(observation, info)
        assert info["action_mask"][action]
        assert action != 0  # it does not stay
        observation, _, _, _, info = env.step(action)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["docstring", "page"])
def test_the_example_of_the_documentation_runs(where, monkeypatch):
    monkeypatch.chdir(ROOT)
    if where == "page":
        page = (ROOT / "docs" / "training.md").read_text(encoding="utf-8")
        (source,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
        names = {}
    else:
        text = re.search(r"::\n\n(.*?)\n\n    Args:", policy_module.Policy.__doc__, re.DOTALL)
        source = re.sub(r"^ {8}", "", text[1], flags=re.MULTILINE)
        names = {"Policy": Policy, "np": np}
    exec(source, names)
    assert names["policy"].metadata.observation == "held"
    assert 0 <= names["action"] < 49
    assert np.isfinite(names["reward"])
    names["env"].close()
