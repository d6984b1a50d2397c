"""PPO of our own: parts against slow versions and PyTorch, learning against Stable-Baselines3."""

import copy
from contextlib import ExitStack
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from learnable_fake import (
    ENV_ID,
    RECALL_ID,
    LearnableFake,
    arguments,
    read_curve,
    with_moments,
    words_of,
)

pytest.importorskip("sb3_contrib")

from ms_slam_agents import ppo, qrdqn, train_sb3
from ms_slam_agents.network import Network
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import Metadata, read_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize


def words(out, *more, steps=64, env_id=ENV_ID):
    learns = {"total_timesteps": steps, "eval_every": 0, "n_steps": 32, "n_epochs": 4}
    return words_of(out, more, env_id, eval_episodes=6, **learns)


def last_return(out):
    return read_curve(out).points[-1]["return"]


def test_advantages_are_those_of_a_loop_over_their_definition():
    rng = np.random.default_rng(0)
    T, B = 12, 3
    rewards, values = rng.normal(size=(2, T, B))
    begins = (rng.random((T, B)) < 0.3).astype(float)
    last, ended = rng.normal(size=B), np.array([0.0, 1.0, 0.0])
    args = ppo.Args(gamma=0.9, gae_lambda=0.8)
    empty = torch.zeros(T, B, 0)
    tensors = [torch.as_tensor(a) for a in (begins, values, rewards)]
    rollout = ppo.Rollout(
        empty, empty, tensors[0], empty, empty, empty, tensors[1], tensors[2], empty
    )
    rollout.find_advantages(torch.as_tensor(last), torch.as_tensor(ended), args)
    following = np.concatenate([values[1:], last[None]])
    over = np.concatenate([begins[1:], ended[None]])
    errors = rewards + 0.9 * following * (1 - over) - values
    for b in range(B):
        for t in range(T):
            total, weight = 0.0, 1.0
            for k in range(t, T):
                total += weight * errors[k, b]
                weight *= 0.9 * 0.8 * (1 - over[k, b])
            assert rollout.advantages[t, b] == pytest.approx(total)


def test_what_a_time_limit_cuts_off_is_the_value_of_the_last_observation(monkeypatch):
    observations, after = [], LearnableFake._next
    monkeypatch.setattr(
        LearnableFake, "_next", lambda self: observations.append(after(self)) or observations[-1]
    )
    make = lambda: gym.make(ENV_ID, max_episode_steps=1)  # noqa: E731
    venv = VecNormalize(DummyVecEnv([make]), training=False, gamma=0.5)
    venv.obs_rms.mean[:], venv.obs_rms.var[:] = 2.0, 25.0
    network = Network(7, 16, 7)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0, 1.0)
    player = ppo.Player(venv, network, ppo.Args(gamma=0.5))
    rollout = player.play(1, lambda: False)
    _, last, _ = observations
    scaled = torch.as_tensor((last - 2) / 5)[None]
    value = network(scaled, torch.zeros(1, 0), torch.ones(1, 7, dtype=torch.bool))[1]
    expected = venv.get_original_reward() + 0.5 * value.item()
    assert rollout.rewards.item() == pytest.approx(expected.item(), rel=1e-4)


def test_chunks_hold_consecutive_steps_of_one_environment():
    steps = torch.arange(7)[:, None] + 100 * torch.arange(2)[None]
    rollout = ppo.Rollout(*[steps] * 9, advantages=steps)
    cut = rollout.chunks(3)["seen"]
    assert sorted(cut.T.tolist()) == [[0, 1, 2], [3, 4, 5], [100, 101, 102], [103, 104, 105]]


def policy_of(network, memory):
    metadata = Metadata("masked_ppo", ENV_ID, "features", 5, (16, 16), (7,), 1, 1, 0.0, memory)
    return Policy(with_moments(network, metadata))


def test_act_remembers_until_it_is_reset():
    torch.manual_seed(0)
    network = Network(5, 16, 7, 8)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0, 1.0)
    policy = policy_of(network, 8)
    seen, mask = np.ones((40, 5)), np.ones(7, bool)
    rng = np.random.default_rng(0)
    seen += rng.normal(size=seen.shape)

    def drawn():
        policy.reset()
        return [policy.act(each, mask, np.random.default_rng(1)) for each in seen]

    first = drawn()
    assert drawn() == first
    forgetful = []
    for each in seen:
        policy.reset()
        forgetful.append(policy.act(each, mask, np.random.default_rng(1)))
    assert forgetful != first


def test_it_learns_what_needs_no_memory_as_well_as_stable_baselines(tmp_path):
    assert ppo.main(words(tmp_path / "own", "--learning-rate", "0.01", steps=1280)) == 0
    more = ("--learning-rate", "0.01", "--no-references")
    theirs = arguments(tmp_path / "sb3", *more, steps=1280)
    assert train_sb3.main(theirs) == 0
    assert last_return(tmp_path / "own") > 8.5
    assert last_return(tmp_path / "own") > last_return(tmp_path / "sb3") - 1


@pytest.mark.slow
def test_only_a_memory_learns_what_needs_one(tmp_path):
    more = ("--learning-rate", "0.01", "--n-steps", "256", "--batch-size", "64", "--gamma", "0.5")
    for memory in (0, 32):
        own = (*more, "--memory", str(memory), "--chunk", "8")
        assert ppo.main(words(tmp_path / str(memory), *own, env_id=RECALL_ID, steps=10_240)) == 0
    assert last_return(tmp_path / "0") < 3.5  # three of ten at most, and one in seven of the rest
    assert last_return(tmp_path / "32") > last_return(tmp_path / "0") + 2


def test_a_memory_is_trained_saved_and_resumed(tmp_path, capsys):
    more = ("--memory", "8", "--chunk", "4")
    assert ppo.main(words(tmp_path / "a", *more)) == 0
    file = read_policy(tmp_path / "a" / "latest.safetensors")
    assert file.metadata.memory == 8
    assert file.metadata.timesteps == 64
    assert file.can_resume
    assert ppo.main(words(tmp_path / "a", *more, "--resume", steps=128)) == 0
    assert read_policy(tmp_path / "a" / "latest.safetensors").metadata.timesteps == 128
    assert [p["timesteps"] for p in read_curve(tmp_path / "a").points] == [0, 64, 128]
    assert ppo.main(["--out", str(tmp_path / "a"), "--resume", "--total-timesteps", "160"]) == 0
    assert read_policy(tmp_path / "a" / "latest.safetensors").metadata.timesteps == 160
    assert ppo.main(words(tmp_path / "a", "--resume", "--memory", "4", steps=256)) == 2
    assert "trained with memory 8, not 4" in capsys.readouterr().err


def test_progress_says_what_the_episodes_returned(tmp_path):
    with ExitStack() as stack:
        args = ppo.Args(out=tmp_path, env_id=ENV_ID, n_steps=80, num_envs=1, episode_steps=10)
        run = ppo.make_run(args, None, stack)
        said = run.advance(lambda: False)
    assert len(run.player.returns) == 8
    assert said["return"] == np.mean(run.player.returns)
    assert said["episode_length"] == 10
    assert 0 < said["return"] < 10


def scalars(out):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    found = events.EventAccumulator(str(out / "tensorboard")).Reload()
    return {name: [e.value for e in found.Scalars(name)] for name in found.Tags()["scalars"]}


@pytest.mark.parametrize("trainer", [ppo, qrdqn])
def test_tensorboard_shows_what_others_look_at(trainer, tmp_path):
    own = {ppo: {"n_steps": 32}, qrdqn: {"save_every": 32, "learning_starts": 16}}[trainer]
    assert trainer.main(words_of(tmp_path, [], total_timesteps=64, eval_every=0, **own)) == 0
    found = scalars(tmp_path)
    names = {"return", "episode_length", "steps_per_s"}
    if trainer is ppo:
        names |= {"approx_kl", "clip_fraction", "explained_variance"}
    assert {f"train/{name}" for name in names} <= found.keys()
    assert found["train/episode_length"] == [10, 10]
    assert min(found["train/steps_per_s"]) > 0


def test_measures_of_an_update_are_those_of_stable_baselines(tmp_path):
    """The second of two epochs of one batch meets the policy that the first one made."""
    args = ppo.Args(out=tmp_path, env_id=ENV_ID, n_steps=64, num_envs=1, episode_steps=10)
    args = replace(args, batch_size=64, hidden=16, learning_rate=0.01, n_epochs=2, clip_range=0.05)
    with ExitStack() as stack:
        run = ppo.make_run(args, None, stack)
        rollout = run.player.play(64, lambda: False)
    start, rng = copy.deepcopy(run.network.state_dict()), np.random.default_rng(0)

    def updated(epochs):
        run.network.load_state_dict(start)
        adam = torch.optim.Adam(run.network.parameters(), args.learning_rate, eps=1e-5)
        return ppo.update(run.network, adam, rollout, replace(args, n_epochs=epochs), 0, rng)

    first = updated(1)
    assert first["approx_kl"] == pytest.approx(0, abs=1e-6)
    assert first["clip_fraction"] == 0
    with torch.no_grad():
        seen, masks = (part.flatten(0, 1) for part in (rollout.seen, rollout.masks))
        log_probs, _ = run.network(seen, torch.zeros(64, 0), masks)
    actions = rollout.actions.flatten()
    log_ratio = (log_probs[range(64), actions] - rollout.log_probs.flatten()).double().numpy()
    second = updated(2)
    expected = np.mean(np.exp(log_ratio) - 1 - log_ratio)
    assert second["approx_kl"] == pytest.approx(expected, rel=1e-3)
    clipped = np.mean(np.abs(np.exp(log_ratio) - 1) > args.clip_range)
    assert 0 < clipped == pytest.approx(2 * second["clip_fraction"])
    values = rollout.values.flatten().numpy()
    returns = values + rollout.advantages.flatten().numpy()
    share = 1 - np.var(returns - values) / np.var(returns)
    assert second["explained_variance"] == pytest.approx(share, rel=1e-5)


def test_the_pull_keeps_it_near_the_policy_that_it_began_with(tmp_path):
    assert ppo.main(words(tmp_path / "first", "--learning-rate", "0.01", steps=640)) == 0
    init = ("--init", str(tmp_path / "first" / "latest.safetensors"), "--learning-rate", "0.03")
    first = Policy.load(tmp_path / "first" / "latest.safetensors")
    seen = (10 * np.eye(7) + 3).astype(np.float32)
    masks = np.ones((7, 7), bool)
    moved = {}
    for pull in ("0", "20"):
        more = (*init, "--pull", pull, "--pull-steps", "1000000", "--ent-coef", "0.5")
        assert ppo.main(words(tmp_path / pull, *more, steps=320)) == 0
        other = Policy.load(tmp_path / pull / "latest.safetensors")
        difference = other.probabilities(seen, masks) - first.probabilities(seen, masks)
        moved[pull] = np.abs(difference).sum()
    assert moved["20"] < 0.5 * moved["0"]


def test_what_is_seen_without_acting_is_remembered_as_well():
    network = Network(5, 16, 7, 8)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0, 0.5)
    acts, sees = policy_of(network, 8), policy_of(network, 8)
    rng, mask = np.random.default_rng(0), np.ones(7, bool)
    before, last = rng.normal(size=(2, 5))
    for policy in (acts, sees):
        policy.reset()
    acts.act(before, mask)
    sees.see(before)
    chances = [p.probabilities(last[None], mask[None], p._memory) for p in (acts, sees)]
    np.testing.assert_array_equal(*chances)
    nothing = sees.probabilities(last[None], mask[None])
    assert np.abs(chances[0] - nothing).max() > 1e-3


@pytest.mark.parametrize("memory", [0, 4])
def test_it_is_pulled_to_what_it_still_is(memory, tmp_path):
    more = ("--memory", str(memory), "--learning-rate", "0.05")
    assert ppo.main(words(tmp_path / "a", *more, env_id=RECALL_ID, steps=256)) == 0
    args = ppo.Args(
        out=tmp_path / "b",
        env_id=RECALL_ID,
        init=tmp_path / "a" / "latest.safetensors",
        learning_rate=0.0,
        pull=1.0,
        memory=memory,
        hidden=16,
        num_envs=1,
        episode_steps=10,
        n_steps=32,
    )
    with ExitStack() as stack:
        run = ppo.make_run(args, None, stack)
        run.venv.training = False  # the moments stay
        rollout = run.player.play(25, lambda: False)
        said = run.advance(lambda: False)
        run.venv.obs_rms.mean += 3  # no concern of what pulls
        moved = run.player.play(9, lambda: False)
    chosen = rollout.pulled_to.gather(2, rollout.actions[..., None])[..., 0]
    torch.testing.assert_close(chosen.log(), rollout.log_probs)
    assert rollout.pulled_to.std(dim=0).max() > 0.02
    assert said["pull"] == pytest.approx(0, abs=1e-5)
    policy = Policy.load(args.init)
    remembered = policy.empty_memory(1)
    rms = run.venv.obs_rms
    for k in range(1, 9 if not memory else 0):  # the first was met before
        met = moved.seen[k].numpy() * np.sqrt(rms.var + 1e-8) + rms.mean
        found = policy.probabilities(met, moved.masks[k].numpy(), remembered)
        np.testing.assert_allclose(moved.pulled_to[k], found, atol=1e-5)


def test_without_weight_the_value_is_left_as_it_is(tmp_path):
    more = ("--value-weight", "0", "--learning-rate", "0.01")
    assert ppo.main(words(tmp_path, *more)) == 0
    assert ppo.main(words(tmp_path, *more, "--resume", steps=96)) == 0
    value = read_policy(tmp_path / "latest.safetensors").part("policy")["value_net.bias"]
    assert abs(value).max() < 1


def test_a_policy_with_other_layers_is_not_begun_with(tmp_path, capsys):
    for name, more in (("plain", ()), ("recurrent", ("--memory", "4"))):
        assert ppo.main(words(tmp_path / name, *more)) == 0
    given = ["--env-id", ENV_ID, "--hidden", "16", "--out", str(tmp_path / "out"), "--init"]
    for trainer, name, said in (
        (ppo, "recurrent", "memory = 4; this one has 0"),
        (train_sb3, "recurrent", "memory = 4; this one has 0"),
        (qrdqn, "plain", "quantiles = 0; this one has 32"),
    ):
        capsys.readouterr()
        assert trainer.main([*given, str(tmp_path / name / "latest.safetensors")]) == 2
        assert said in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
    assert train_sb3.Args(observation="held").layers["candidates"] == 0
    assert ppo.Args(observation="held").layers["candidates"] > 0
