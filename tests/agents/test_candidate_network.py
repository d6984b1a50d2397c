"""A network that looks at candidates one by one: order, NumPy against PyTorch, moments, a run."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from learnable_fake import LearnableFake, read_curve, with_moments, words_of

pytest.importorskip("sb3_contrib")

from ms_slam_agents import options, ppo
from ms_slam_agents.network import Network
from ms_slam_agents.normalization import PooledMoments
from ms_slam_agents.policy_file import Metadata, read_policy

from ms_slam_env.errors import InputError

STATE, ACTIONS, NUMBERS = 4, 7, 3
INPUTS = STATE + ACTIONS * NUMBERS
ENV_ID = "LearnableCandidates-v0"


class Candidates(LearnableFake):
    """The right action is the one whose second number is the largest; the state says nothing."""

    inputs = INPUTS

    def _next(self):
        super()._next()
        numbers = self.np_random.uniform(size=(ACTIONS, NUMBERS))
        numbers[self.right, 1] = 1.5
        state = self.np_random.uniform(size=STATE)
        return np.concatenate([state, numbers.ravel()]).astype(np.float32)


gym.register(ENV_ID, Candidates)


@pytest.fixture(autouse=True)
def numbers_of_the_fake(monkeypatch):
    own = property(lambda args: NUMBERS if args.observation == "candidates" else 0)
    monkeypatch.setattr(options.Problem, "candidates", own)


def make_network(memory=0):
    torch.manual_seed(0)
    network = Network(INPUTS, 16, ACTIONS, memory, NUMBERS)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0, 0.5)
    return network


def file_of(network, memory=0):
    metadata = Metadata(
        *("masked_ppo", ENV_ID, "candidates", INPUTS, (16, 16), (ACTIONS,), 1, 1, 0.0),
        memory=memory,
        candidates=NUMBERS,
    )
    return with_moments(network, metadata)


@pytest.mark.parametrize("numbers", [NUMBERS, 0])
def test_what_is_dropped_is_dropped_while_it_trains_alone(numbers):
    torch.manual_seed(0)
    network = Network(INPUTS, 16, ACTIONS, candidates=numbers, dropout=0.5)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0, 0.5)
    seen, memory = (1 + torch.rand(INPUTS)).expand(200, -1), torch.zeros(200, 0)
    can = torch.ones(200, ACTIONS, dtype=torch.bool)
    trained, _ = network(seen, memory, can)
    layers, _ = network._look(seen)
    known, _ = network.eval()._look(seen)
    dropped = layers == 0
    assert dropped.double().mean() == pytest.approx(0.5, abs=0.05)
    torch.testing.assert_close(layers[~dropped], 2 * known[~dropped])
    assert len(trained.unique(dim=0)) > 100
    assert len(network(seen, memory, can)[0].unique(dim=0)) == 1


def test_the_order_of_the_candidates_means_nothing():
    network, rng = make_network(memory=5), np.random.default_rng(1)
    seen, order = rng.normal(size=(6, INPUTS)), rng.permutation(ACTIONS)
    masks = rng.random((6, ACTIONS)) < 0.7
    masks[:, 2] = True
    rows = seen[:, STATE:].reshape(6, ACTIONS, NUMBERS)
    moved = np.concatenate([seen[:, :STATE], rows[:, order].reshape(6, -1)], axis=1)
    found = []
    for one, mask in ((seen, masks), (moved, masks[:, order])):
        tensor = torch.as_tensor(one, dtype=torch.float32)
        with torch.no_grad():
            memory = network.remember(tensor, torch.zeros(6, 5), torch.zeros(6))
            log_probs, values = network(tensor, memory, torch.as_tensor(mask))
        found.append((log_probs.exp().numpy(), values.numpy()))
    np.testing.assert_allclose(found[1][0], found[0][0][:, order], atol=1e-6)
    np.testing.assert_allclose(found[1][1], found[0][1], atol=1e-6)


def test_moments_are_those_of_all_candidates_together():
    rng = np.random.default_rng(2)
    batches = [rng.normal(k, 1 + k, size=(50, INPUTS)) for k in range(4)]
    moments = PooledMoments(INPUTS, ACTIONS, NUMBERS)
    for batch in batches:
        moments.update(batch)
    every = np.concatenate(batches)
    rows = every[:, STATE:].reshape(-1, NUMBERS)
    mean = np.concatenate([every[:, :STATE].mean(axis=0), np.tile(rows.mean(axis=0), ACTIONS)])
    var = np.concatenate([every[:, :STATE].var(axis=0), np.tile(rows.var(axis=0), ACTIONS)])
    np.testing.assert_allclose(moments.mean, mean, atol=1e-4)
    np.testing.assert_allclose(moments.var, var, rtol=1e-3)


def test_ppo_learns_by_it_and_goes_on(tmp_path):
    learns = {"total_timesteps": 2048, "n_steps": 256, "n_epochs": 8, "batch_size": 64}
    more = {"observation": "candidates", "hidden": 32, "gamma": 0.5, "learning_rate": 0.003}

    def run(*words):
        judged = {"eval_episodes": 6, "eval_every": 0}
        return ppo.main(words_of(tmp_path / "run", words, ENV_ID, **learns | more | judged))

    assert run() == 0
    points = read_curve(tmp_path / "run").points
    assert points[-1]["return"] > 8 > 5 > points[0]["return"]
    file = read_policy(tmp_path / "run" / "latest.safetensors")
    assert file.metadata.candidates == NUMBERS
    mean = file.part("observation")["mean"][STATE:].reshape(ACTIONS, NUMBERS)
    np.testing.assert_array_equal(mean, np.tile(mean[0], (ACTIONS, 1)))
    assert run("--resume", "--total-timesteps", "2304") == 0
    assert read_policy(tmp_path / "run" / "latest.safetensors").metadata.timesteps == 2304


def test_numbers_that_do_not_hold_the_candidates_are_refused():
    metadata = file_of(make_network()).metadata
    with pytest.raises(InputError, match="do not hold 9 for each"):
        Metadata(**{**vars(metadata), "candidates": 9}).check()
