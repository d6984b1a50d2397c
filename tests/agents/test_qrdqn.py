"""QR-DQN: parts against slow versions and closed forms, a known optimum, masks, going on."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from learnable_fake import ENV_ID, LearnableFake, read_curve, words_of

pytest.importorskip("sb3_contrib")

from ms_slam_agents import qrdqn
from ms_slam_agents.network import Network
from ms_slam_agents.normalization import Normalization
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import Metadata, PolicyFile, read_policy, write_policy

from ms_slam_env.errors import InputError

WALK_ID = "LearnableWalk-v0"
PLACES, GAMMA = 6, 0.8
LEFT, RIGHT, AHEAD = 0, 1, 2


class Walk(LearnableFake):
    """A row of places: 0.2 for leaving it on the left, 1 on the right, 9 for what is blocked."""

    inputs = PLACES

    def __init__(self, **options):
        super().__init__(**options)
        self.action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        self.place, self.mask = int(self.np_random.integers(PLACES)), np.array([True, True, False])
        return self._here(), self._info(0.0)

    def step(self, action):
        self.log.append((self.split, bool(self.mask[action])))
        self.place += {LEFT: -1, RIGHT: 1, AHEAD: 0}[int(action)]
        reward = {-1: 0.2, PLACES: 1.0}.get(self.place, 9.0 * (action == AHEAD))
        is_over = not 0 <= self.place < PLACES
        return self._here(), reward, is_over, False, self._info(reward)

    def _here(self):
        return np.eye(PLACES, dtype=np.float32)[np.clip(self.place, 0, PLACES - 1)]

    def _info(self, reward):
        self.score = reward
        return super()._info(reward)


gym.register(WALK_ID, Walk)


def words(out, *more, steps=64, env_id=ENV_ID, **options):
    learns = {
        "total_timesteps": steps,
        "eval_every": 0,
        "quantiles": 5,
        "learning_starts": 32,
        "save_every": 32,
        "train_every": 1,
        "target_every": 20,
    }
    return words_of(out, more, env_id, eval_episodes=6, **learns | options)


def test_the_loss_is_that_of_loops_over_its_definition():
    rng = np.random.default_rng(0)
    found, wanted = 2 * rng.normal(size=(4, 5)), 2 * rng.normal(size=(4, 3))
    slow = 0.0
    for b in range(4):
        for i in range(5):
            for j in range(3):
                u = wanted[b, j] - found[b, i]
                huber = u**2 / 2 if abs(u) <= 1 else abs(u) - 0.5
                slow += abs((i + 0.5) / 5 - (u < 0)) * huber / 3 / 4
    assert qrdqn.quantile_loss(torch.as_tensor(found), torch.as_tensor(wanted)) == pytest.approx(
        slow
    )


def test_fitted_quantiles_are_those_of_the_samples():
    samples = torch.linspace(0, 100, 401, dtype=torch.float64)[None]  # far beyond Huber's bend
    found = torch.full((1, 4), 50.0, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([found], 1.0)
    for k in range(150):
        optimizer.param_groups[0]["lr"] = 3.0 * 0.96**k
        optimizer.zero_grad()
        qrdqn.quantile_loss(found, samples).backward()
        optimizer.step()
    expected = np.quantile(samples, [1 / 8, 3 / 8, 5 / 8, 7 / 8])
    np.testing.assert_allclose(found.detach()[0], expected, atol=1.0)


def make_learner(file=None, **options):
    args = qrdqn.Args(hidden=16, quantiles=5, target_every=3, batch_size=8, **options)
    return qrdqn.Learner(args, Normalization(4, 3, 0, 0.9), 3, file)


def make_replay(count=60):
    replay, rng = qrdqn.Replay(count, 4, 3), np.random.default_rng(0)
    for _ in range(count):
        mask = rng.random(3) < 0.5
        mask[rng.integers(3)] = True
        seen, after = rng.normal(size=(2, 4))
        replay.add((seen, int(rng.integers(3)), rng.normal(), after, mask, 0.9))
    return replay


def test_the_target_is_the_targets_word_on_the_best_possible_action():
    learner = make_learner()
    for network in (learner.network, learner.target):
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter, 0, 1.0)
    _, _, rewards, after, masks, worth = map(
        torch.as_tensor, make_replay().draw(np.random.default_rng(0), 40)
    )
    found = learner.targets(rewards, after, masks, worth)
    with torch.no_grad():
        own, said = learner.network.quantiles(after), learner.target.quantiles(after)
    differs = 0
    for b in range(40):
        means = [float(own[b, a].mean()) if masks[b, a] else -math.inf for a in range(3)]
        best = int(np.argmax(means))
        differs += best != int(own[b].mean(dim=1).argmax())
        differs += best != int(said[b].mean(dim=1).argmax())
        np.testing.assert_allclose(found[b], (rewards[b] + 0.9 * said[b, best]))
    assert differs > 20  # the mask, and whose word it is, matter


@pytest.mark.parametrize("is_terminated", [True, False])
def test_returns_of_several_steps_are_sums_that_stop_at_the_end(is_terminated):
    returns = qrdqn.Returns(3, 0.5)
    made = []
    for t in range(5):
        before = (np.array([t]), t, float(10**t))
        made += returns.step(
            before, (np.array([t + 1]), np.ones(1)), t == 4, is_terminated and t == 4
        )
    starts = [int(one[0][0]) for one in made]
    assert starts == [one[1] for one in made] == [0, 1, 2, 3, 4]
    for start, (_, _, total, after, _, worth) in enumerate(made):
        end = min(start + 3, 5)
        assert total == sum(0.5**k * 10 ** (start + k) for k in range(end - start))
        assert int(after[0]) == end
        assert worth == (0 if is_terminated and end == 5 else 0.5 ** (end - start))


def test_the_replay_keeps_the_latest():
    replay = qrdqn.Replay(4, 1, 2)
    for k in range(6):
        replay.add((np.array([k]), k, 0.0, np.array([k]), np.ones(2, bool), 1.0))
    assert len(replay) == 4
    assert set(replay.draw(np.random.default_rng(0), 100)[1]) == {2, 3, 4, 5}


def test_a_learner_that_goes_on_from_its_file_is_the_one_that_never_stopped(tmp_path):
    """Network, target, optimiser and count; seven updates, the target copied every three."""
    replay, rng = make_replay(), np.random.default_rng(3)
    batches = [replay.draw(rng, 8) for _ in range(7)]
    whole, first = make_learner(), make_learner()
    for batch in batches:
        whole.learn(batch)
    for batch in batches[:4]:
        first.learn(batch)
    metadata = Metadata("qr_dqn", ENV_ID, "features", 4, (16, 16), (3,), 4, 1, 0.0, quantiles=5)
    write_policy(tmp_path / "policy", PolicyFile(metadata, first.tensors()))
    second = make_learner(read_policy(tmp_path / "policy"))
    for batch in batches[4:]:
        second.learn(batch)
    expected, found = whole.tensors(), second.tensors()
    assert expected.keys() == found.keys()
    assert any(name.startswith("target.") for name in found)
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)


@pytest.mark.parametrize("candidates", [0, 3])
def test_the_policy_in_numpy_takes_the_networks_best_action(candidates, tmp_path):
    torch.manual_seed(0)
    inputs = 5 + 7 * candidates
    network = Network(inputs, 16, 7, 0, candidates, 6)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0, 0.7)
    metadata = Metadata(
        *("qr_dqn", ENV_ID, "candidates", inputs, (16, 16), (7,), 1, 1, 0.0),
        candidates=candidates,
        quantiles=6,
    )
    moments = Normalization(inputs, 7, candidates, 0.9)
    tensors = network.tensors() | qrdqn.moment_tensors(moments)
    write_policy(tmp_path / "policy", PolicyFile(metadata, tensors))
    policy = Policy.load(tmp_path / "policy")
    rng = np.random.default_rng(0)
    seen, masks = rng.normal(size=(200, inputs)), rng.random((200, 7)) < 0.6
    masks[:, 0] = True
    with torch.no_grad():
        quantiles = network.quantiles(torch.as_tensor(moments.scaled(seen)))
    expected = qrdqn.masked_best(quantiles, torch.as_tensor(masks)).numpy()
    found = policy.probabilities(seen, masks)
    np.testing.assert_array_equal(found, np.eye(7)[expected])
    assert len(set(expected)) > 3
    assert policy.act(seen[0], masks[0], rng) == policy.act(seen[0], masks[0]) == expected[0]


def test_it_finds_a_known_optimum_with_its_value_and_never_what_is_blocked(tmp_path):
    """Right from everywhere: gamma to the places left is more than 0.2; blocked would be 9."""
    Walk.log.clear()
    run = words(tmp_path, steps=1500, env_id=WALK_ID, gamma=GAMMA, learning_rate=0.005, n_step=1)
    assert qrdqn.main([*run, "--exploration", "0.7"]) == 0  # n_step: exploring is in the sums
    assert len(Walk.log) > 1500
    assert all(possible for _, possible in Walk.log)
    file = read_policy(tmp_path / "latest.safetensors")
    policy = Policy(file)
    places, masks = np.eye(PLACES), np.tile([True, True, False], (PLACES, 1))
    assert policy.probabilities(places, masks)[:, RIGHT].all()
    network = Network(PLACES, 16, 3, quantiles=5)
    qrdqn.load_parameters(network, file)
    normalization = Normalization(PLACES, 3, 0, GAMMA)
    qrdqn.restore_moments(normalization, file)
    with torch.no_grad():
        quantiles = network.quantiles(torch.as_tensor(normalization.scaled(places)))
    found = normalization.return_scale * quantiles.mean(dim=2).numpy()
    right = GAMMA ** np.arange(PLACES - 1, -1, -1)
    left = np.concatenate([[0.2], GAMMA * right[:-1]])
    np.testing.assert_allclose(found[:, [LEFT, RIGHT]], np.stack([left, right], 1), atol=0.03)
    assert list((tmp_path / "tensorboard").glob("events*"))
    assert read_curve(tmp_path).points[-1]["return"] == 1


def test_a_run_goes_on_with_its_count_and_a_new_replay(tmp_path, capsys):
    assert qrdqn.main(words(tmp_path)) == 0
    before = read_policy(tmp_path / "latest.safetensors")
    assert (before.metadata.timesteps, before.metadata.quantiles) == (64, 5)
    updates = int(before.tensors["optimizer.step"])
    assert updates == 33  # from the 32nd step on, one a step
    assert qrdqn.main(words(tmp_path, "--resume", steps=128)) == 0
    after = read_policy(tmp_path / "latest.safetensors")
    assert after.metadata.timesteps == 128
    assert int(after.tensors["optimizer.step"]) == updates + 33
    assert [p["timesteps"] for p in read_curve(tmp_path).points] == [0, 64, 128]
    assert qrdqn.main(words(tmp_path, "--resume", steps=256, quantiles=6)) == 2
    assert "trained with quantiles 5, not 6" in capsys.readouterr().err


def test_quantiles_that_no_network_has_are_refused():
    whole = ("qr_dqn", ENV_ID, "features", 4, (16, 16), (3,), 4, 1, 0.0)
    with pytest.raises(InputError, match="quantiles = -1"):
        Metadata(*whole, quantiles=-1).check()
    with pytest.raises(InputError, match="with no memory"):
        Metadata(*whole, quantiles=3, memory=4).check()
