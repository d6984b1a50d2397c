"""RLlib: the module against NumPy, normalisation, and a run on a local cluster of several processes
of which one is killed."""

import os
import signal
import socket
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("ray", reason="ray is not installed: extra rllib")
pytest.importorskip("tree", reason="dm-tree is not installed: extra rllib")

import gymnasium as gym
import learnable_fake
import ray
import torch
from learnable_fake import ENV_ID, NUM_ACTIONS, LearnableFake, read_curve, words_of
from ms_slam_agents import rllib_scaling, train_rllib, training_run
from ms_slam_agents.normalization import moment_tensors
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import Metadata, PolicyFile, read_policy
from ray.cluster_utils import Cluster
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from ms_slam_env.errors import InputError

INPUTS, CANDIDATES = 4 + NUM_ACTIONS * 3, 3


def make_module(candidates, image=(), inputs=INPUTS):
    torch.manual_seed(0)
    spaces = gym.spaces.Box(-np.inf, np.inf, (inputs,), np.float32)
    config = {"inputs": inputs, "actions": NUM_ACTIONS, "hidden": 16}
    config |= {"candidates": candidates, "image": image}
    module = train_rllib.MaskedModule(
        observation_space=gym.spaces.Dict({"observations": spaces}),
        action_space=gym.spaces.Discrete(NUM_ACTIONS),
        model_config=config | {"gamma": 0.5},
    )
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter, 0, 0.5)
    return module


def test_a_batch_larger_than_a_round_is_refused():
    fits = train_rllib.Args(n_steps=32, num_envs=2, envs_per_runner=2, batch_size=128)
    assert fits.round_steps == 128
    with pytest.raises(InputError, match=r"batch_size = 129 .* 128 steps"):
        replace(fits, batch_size=129)


@pytest.mark.parametrize(
    ("candidates", "image", "inputs"),
    [(0, (), INPUTS), (CANDIDATES, (), INPUTS), (0, (1, 17, 18), 4 + 17 * 18)],
)
def test_the_policy_in_numpy_is_the_module_with_its_masks_and_moments(candidates, image, inputs):
    module, rng = make_module(candidates, image, inputs), np.random.default_rng(0)
    seen = rng.normal(3, 5, size=(50, inputs)).astype(np.float32)
    masks = rng.random((50, NUM_ACTIONS)) < 0.6
    masks[:, 0] = True
    normalization = module.normalization
    normalization.obs_rms.update(seen[:20])
    module.normalization = normalization
    batch = {"observations": torch.as_tensor(seen), "action_mask": torch.as_tensor(masks)}
    logits = module.forward_exploration({"obs": batch})["action_dist_inputs"]
    chosen = module.get_exploration_action_dist_cls().from_logits(logits)
    metadata = Metadata(
        *("rllib_ppo", ENV_ID, "candidates", inputs, (16, 16), (NUM_ACTIONS,), 1, 1, 0.0),
        candidates=candidates,
        image=image,
    )
    tensors = module.network.tensors() | moment_tensors(module.normalization)
    policy = Policy(PolicyFile(metadata, tensors))
    found = policy.probabilities(seen, masks)
    np.testing.assert_allclose(found, torch.softmax(logits, dim=1), atol=1e-4)
    assert not found[~masks].any()
    drawn = torch.stack([chosen.sample() for _ in range(200)])
    assert masks[np.arange(50), drawn.numpy()].all()
    deterministic = chosen.to_deterministic().sample().numpy()
    np.testing.assert_array_equal(deterministic, found.argmax(axis=1))


def test_moments_and_rewards_are_those_of_what_was_met_without_the_step_that_rllib_adds():
    module, rng = make_module(0), np.random.default_rng(1)
    seen, rewards = rng.normal(2, 3, size=(2, 9, INPUTS)), rng.normal(size=(2, 8))
    episodes = [
        SingleAgentEpisode(
            observations=[{"observations": row} for row in seen[k]],
            actions=[0] * 8,
            rewards=[*rewards[k, :7], 99.0],  # the last is not met
            len_lookback_buffer=0,
        ).to_numpy()
        for k in range(2)
    ]
    train_rllib.Normalize()(rl_module={train_rllib.MODULE: module}, batch={}, episodes=episodes)
    met = seen[:, :7].reshape(-1, INPUTS)
    np.testing.assert_allclose(module.observation_mean, met.mean(axis=0), atol=1e-4)
    np.testing.assert_allclose(module.observation_var, met.var(axis=0), rtol=1e-3)
    sums = np.zeros((2, 7))
    for t in range(7):
        sums[:, t] = rewards[:, t] + (0.5 * sums[:, t - 1] if t else 0)
    np.testing.assert_allclose(module.return_var, sums.var(), rtol=1e-3)
    scale = np.sqrt(float(module.return_var) + 1e-8)
    np.testing.assert_allclose(episodes[1].get_rewards()[:7], rewards[1, :7] / scale, rtol=1e-5)


def make_fake(args, runner=0):
    """In a runner's process, to which the fake environment is new."""
    assert learnable_fake.ENV_ID in gym.registry
    return train_rllib.Masked(train_rllib.make_env(args, "train", ()), runner)


def test_runners_are_of_several_tasks_in_turn():
    args = train_rllib.Args(scenes=("table",), also=("arm-kinematic",))
    held = [train_rllib.make_masked(args, k).unwrapped.config.arm.frames_per_action for k in (1, 2)]
    assert held[1] == 1 != held[0]


def test_a_seed_means_other_episodes_in_another_runner():
    args = train_rllib.Args(env_id=ENV_ID, episode_steps=10)
    first, other = make_fake(args, 1), make_fake(args, 2)
    for env in (first, other):
        env.reset(seed=3)
        env.seen = [env.step(env.unwrapped.right)[0]["observations"] for _ in range(9)]
    assert not np.array_equal(first.seen, other.seen)
    again = first.reset(seed=3)[0]["observations"]
    np.testing.assert_array_equal(again, first.reset(seed=3)[0]["observations"])


class Strict(gym.Wrapper):
    """Refuses blocked actions, wherever it runs."""

    def step(self, action):
        assert self.env.unwrapped.mask[action]
        return self.env.step(action)


def make_strict(args, runner):
    assert runner > 0
    return train_rllib.Masked(Strict(make_fake(args).env), runner)


def words(out, *more, steps):
    learns = {"total_timesteps": steps, "n_steps": 64, "n_epochs": 6, "batch_size": 32}
    judged = {"num_envs": 2, "eval_episodes": 6, "eval_every": 0}
    return words_of(out, more, gamma=0.5, learning_rate=0.01, **learns | judged)


@pytest.fixture
def cluster(monkeypatch):
    """Ray with two runners, whose processes know this module; validation in this process."""
    monkeypatch.setattr(train_rllib, "make_masked", make_strict)
    plain = training_run.make_venv
    alone = lambda args, *rest: plain(replace(args, num_envs=1), *rest)  # noqa: E731
    monkeypatch.setattr(training_run, "make_venv", alone)
    known = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, known)))
    names = ("metrics_agent", "metrics_export", "dashboard_agent_listen", "runtime_env_agent")
    ports = {f"{name}_port": port for name, port in zip(names, free_ports(), strict=True)}
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 3, **ports})
    ray.init(nodes.address, log_to_driver=False)
    yield
    ray.shutdown()
    nodes.shutdown()


def free_ports():
    """Four ports: a node that is told them need not wait for who opens them on a busy machine."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(4)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


def wait_for_both(ppo):
    for _ in range(300):
        if ppo.env_runner_group.num_healthy_remote_workers() == 2:
            return
        ppo.restore_env_runners(ppo.env_runner_group)
        time.sleep(1)


@pytest.mark.slow
def test_a_runner_is_killed_the_training_goes_on_and_is_resumed(cluster, tmp_path, monkeypatch):
    advance, pids = train_rllib.Run.advance, []

    def advance_and_kill(self, stop):
        said = advance(self, stop)
        runners = self.ppo.env_runner_group.foreach_env_runner(
            lambda runner: os.getpid(), local_env_runner=False
        )
        pids.append(sorted(runners))
        if len(pids) == 2:
            os.kill(runners[0], signal.SIGKILL)
        if len(pids) == 5:  # the training went on alone; now it may have company again
            wait_for_both(self.ppo)
        return said

    monkeypatch.setattr(train_rllib.Run, "advance", advance_and_kill)
    LearnableFake.log.clear()
    assert train_rllib.main(words(tmp_path, steps=1280)) == 0
    before = set(pids[1])
    assert len(before) == 2
    assert os.getpid() not in before
    assert len(pids[2]) == 1
    assert len(set(pids[-1]) & before) == 1  # the other one is new
    assert len(pids[-1]) == 2
    file = read_policy(tmp_path / "latest.safetensors")
    assert file.metadata.timesteps >= 1280
    assert file.metadata.algorithm == "rllib_ppo"
    first, last = read_curve(tmp_path).points
    assert last["return"] > 6 > 4 > first["return"]  # of 10
    # All that was met is in the moments, but for what the killed runner had.
    met = float(file.tensors["observation.count"])
    assert met == pytest.approx(file.metadata.timesteps, abs=1)

    more = words(tmp_path, "--resume", steps=file.metadata.timesteps + 128)
    assert train_rllib.main(more) == 0
    after = read_policy(tmp_path / "latest.safetensors")
    assert after.metadata.timesteps == file.metadata.timesteps + 128
    assert after.tensors["optimizer.step"] > file.tensors["optimizer.step"]
    points = read_curve(tmp_path).points
    assert [p["timesteps"] for p in points] == [
        0,
        file.metadata.timesteps,
        after.metadata.timesteps,
    ]
    assert points[-1]["return"] > 6


def test_by_default_a_round_of_one_runner_of_the_scaling_fills_a_batch():
    args = rllib_scaling.Scaling()
    assert args.batch_size <= args.n_steps


def test_a_batch_of_the_scaling_is_a_round_of_the_fewest_runners_at_most():
    rllib_scaling.Scaling(runners=(4, 8), n_steps=128, batch_size=512)
    with pytest.raises(InputError, match="batch_size = 512"):
        rllib_scaling.Scaling(runners=(4, 1), num_envs=4, n_steps=128, batch_size=512)
