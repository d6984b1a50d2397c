"""Recorded episodes: what the dataset holds is what happened, and it can be learnt from."""

import gymnasium as gym
import numpy as np
import pytest

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.cli import main
from ms_slam_env.env.planners import make_planner

minari = pytest.importorskip("minari")

WORDS = ["record", "--scenes", "table", "--scene-seeds", "1", "--options", "image_size=80x60"]


def record(out, *more):
    return main([*WORDS, "--out", str(out), *map(str, more)])


def load(out, name, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(out))
    return minari.load_dataset(name)


def replayed(seed, observation, steps):
    env = gym.make(
        "MSActiveSLAM-FreeCamera-v0",
        scene=["table"],
        split="train",
        num_scene_seeds=1,
        image_size="80x60",
        observation=observation,
    )
    seen, info = env.reset(seed=seed)
    stream = np.random.default_rng([seed, 2])
    planner = make_planner("random", env.unwrapped, seed=int(stream.integers(2**31)))
    planner.reset()
    observations, rewards, masks = [seen], [], [info["action_mask"]]
    for _ in range(steps):
        seen, reward, *_, info = env.step(planner.act(seen, info))
        observations.append(seen)
        rewards.append(reward)
        masks.append(info["action_mask"])
    return observations, rewards, masks


def test_the_dataset_is_what_happened(tmp_path, monkeypatch, capsys):
    assert record(tmp_path, "--planner", "random", "--episodes", 2, "--steps", 4) == 0
    assert "minari.load_dataset('random-v0')" in capsys.readouterr().out
    dataset = load(tmp_path, "random-v0", monkeypatch)
    assert dataset.total_episodes == 2
    assert dataset.total_steps == 8
    for seed, episode in enumerate(dataset):
        observations, rewards, masks = replayed(seed, "features", 4)
        np.testing.assert_array_equal(episode.observations, observations)
        np.testing.assert_array_equal(episode.rewards, rewards)
        np.testing.assert_array_equal(episode.infos["action_mask"], masks)
        assert episode.truncations.tolist() == [False, False, False, True]
    assert dataset.recover_environment().spec.kwargs["image_size"] == "80x60"


def test_observations_of_several_parts(tmp_path, monkeypatch):
    words = ("--planner", "random", "--episodes", 1, "--steps", 2, "--observation", "rgbd")
    assert record(tmp_path, *words, "--name", "pictures-v3") == 0
    (episode,) = load(tmp_path, "pictures-v3", monkeypatch)
    observations, _, _ = replayed(0, "rgbd", 2)
    for part in ("color", "depth", "state"):
        expected = np.stack([each[part] for each in observations])
        np.testing.assert_array_equal(episode.observations[part], expected)  # no lossy JPEG


def test_a_network_learns_from_it(tmp_path, monkeypatch):
    torch = pytest.importorskip("torch")
    assert record(tmp_path, "--planner", "greedy", "--episodes", 3, "--steps", 15) == 0
    dataset = load(tmp_path, "greedy-v0", monkeypatch)
    seen = torch.as_tensor(np.concatenate([e.observations[:-1] for e in dataset]))
    done = torch.as_tensor(np.concatenate([e.actions for e in dataset]))
    torch.manual_seed(0)
    network = torch.nn.Linear(seen.shape[1], 49)
    optimizer = torch.optim.Adam(network.parameters(), lr=0.01)
    losses = []
    for _ in range(150):
        loss = torch.nn.functional.cross_entropy(network(seen), done)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.3 * losses[0]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--planner", "nobody"), "unknown planner 'nobody'"),
        (("--env-id", "Nothing-v0"), "Nothing-v0'; valid choices"),
        (("--scenes", "kitchn"), "unknown scene 'kitchn'"),
        (("--observation", "smell"), "unknown observation 'smell'"),
        (("--options", "colour"), "not name=value"),
        (("--options", "scene=wall"), "option 'scene' is not free"),
        (("--episodes", "0"), "episodes"),
        (("--name", "../x-v0"), "not of the form NAME-v0"),
    ],
)
def test_bad_options_are_one_line_and_leave_nothing(tmp_path, capsys, words, said):
    assert record(tmp_path / "out", *words) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_dataset_is_not_overwritten(tmp_path, capsys):
    words = ("--planner", "random", "--episodes", 1, "--steps", 1)
    assert record(tmp_path, *words) == 0
    assert record(tmp_path, *words) == 2
    assert "is there already" in capsys.readouterr().err
