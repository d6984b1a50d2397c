"""Recorded episodes: what the dataset holds is what happened."""

import io
import json

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.cli import main
from ms_slam_env.env.lerobot_dataset import DatasetWriter, Steps
from ms_slam_env.env.planners import make_planner

minari = pytest.importorskip("minari")
pq = pytest.importorskip("pyarrow.parquet")
pd = pytest.importorskip("pandas")

WORDS = ["record", "--scenes", "table", "--scene-seeds", "1"]
SMALL = "image_size=80x60"


def record(out, *more, options=()):
    return main([*WORDS, "--options", SMALL, *options, "--out", str(out), *map(str, more)])


def load(out, name, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(out))
    return minari.load_dataset(name)


def replayed(seed, observation, steps=4, env_id="MSActiveSLAM-FreeCamera-v0"):
    """Observation, action, reward, mask and end of each step of an episode played again."""
    env = gym.make(
        env_id,
        scene=["table"],
        split="train",
        num_scene_seeds=1,
        image_size="80x60",
        observation=observation,
        max_episode_steps=steps,
    )
    seen, info = env.reset(seed=seed)
    stream = np.random.default_rng([seed, 2])
    planner = make_planner("random", env.unwrapped, seed=int(stream.integers(2**31)))
    planner.reset()
    is_over = False
    while not is_over:
        action = planner.act(seen, info)
        after, reward, terminated, truncated, later = env.step(action)
        is_over = terminated or truncated
        yield seen, action, reward, info["action_mask"], is_over
        seen, info = after, later


def test_the_dataset_is_what_happened_and_is_not_overwritten(tmp_path, monkeypatch, capsys):
    words = ("--planner", "random", "--episodes", 2, "--steps", 4)
    assert record(tmp_path, *words) == 0
    assert "minari.load_dataset('random-v0')" in capsys.readouterr().out
    dataset = load(tmp_path, "random-v0", monkeypatch)
    assert dataset.total_episodes == 2
    assert dataset.total_steps == 8
    for seed, episode in enumerate(dataset):
        observations, actions, rewards, masks, ends = zip(*replayed(seed, "features"), strict=True)
        np.testing.assert_array_equal(episode.observations[:-1], observations)
        np.testing.assert_array_equal(episode.actions, actions)
        np.testing.assert_array_equal(episode.rewards, rewards)
        np.testing.assert_array_equal(episode.infos["action_mask"][:-1], masks)
        assert episode.truncations.tolist() == list(ends)
    assert dataset.recover_environment().spec.kwargs["image_size"] == "80x60"
    assert record(tmp_path, *words) == 2
    assert "is there already" in capsys.readouterr().err


def test_observations_of_several_parts(tmp_path, monkeypatch):
    words = ("--planner", "random", "--episodes", 1, "--steps", 2, "--observation", "rgbd")
    assert record(tmp_path, *words, "--name", "pictures-v3") == 0
    (episode,) = load(tmp_path, "pictures-v3", monkeypatch)
    observations = [seen for seen, *_ in replayed(0, "rgbd", 2)]
    for part in ("color", "depth", "state"):
        expected = np.stack([each[part] for each in observations])
        found = episode.observations[part][:-1]
        np.testing.assert_array_equal(found, expected)  # no lossy JPEG


def test_the_rewards_of_a_task(tmp_path, monkeypatch):
    room = "MSActiveSLAM-Room-v0"
    words = ("--planner", "random", "--episodes", 1, "--steps", 4, "--env-id", room)
    assert record(tmp_path, *words) == 0
    (episode,) = load(tmp_path, "random-v0", monkeypatch)
    paid, plain = (
        [reward for _, _, reward, *_ in replayed(0, "features", env_id=name)]
        for name in (room, "MSActiveSLAM-FreeCamera-v0")
    )
    assert episode.rewards.tolist() == paid != plain


@pytest.mark.parametrize("form", ["minari", "lerobot"])
def test_continuous_actions(tmp_path, monkeypatch, form):
    words = ("--planner", "random", "--episodes", 1, "--steps", 3, "--format", form)
    assert record(tmp_path, *words, options=["actions=continuous"]) == 0
    if form == "minari":
        (episode,) = load(tmp_path, "random-v0", monkeypatch)
        actions, shares = episode.actions, episode.infos["travelled"][1:]
    else:
        _, _, (rows,) = rows_of(tmp_path / "random-v0")
        actions = np.float32([row["action"] for row in rows])
        shares = [row["info.travelled"] for row in rows[1:]]
    env = gym.make(
        "MSActiveSLAM-FreeCamera-Continuous-v0",
        scene="table",
        num_scene_seeds=1,
        image_size="80x60",
    )
    env.reset(seed=0)
    happened = [env.step(action)[-1]["travelled"] for action in actions]
    assert happened[: len(shares)] == list(shares)
    assert len(np.unique(actions)) == 18


# -- In LeRobot's format, read back as its reader does: Parquet files, JSON, PNG ---------------


RNG = np.random.default_rng(0)


def rows_of(folder):
    """Columns of all data files, by the paths that each episode names."""
    info = json.loads((folder / "meta/info.json").read_text())
    episodes = pq.read_table(folder / "meta/episodes").to_pylist()
    rows = []
    for episode in episodes:
        where = {key: episode[f"data/{key}"] for key in ("chunk_index", "file_index")}
        table = pq.read_table(folder / info["data_path"].format(**where)).to_pylist()
        own = [row for row in table if row["episode_index"] == episode["episode_index"]]
        assert len(own) == episode["length"]
        assert [row["index"] for row in own] == list(
            range(episode["dataset_from_index"], episode["dataset_to_index"])
        )
        rows.append(own)
    return info, episodes, rows


@pytest.mark.parametrize("observation", ["features", "rgbd", "images"])
def test_a_dataset_for_lerobot_is_what_happened(tmp_path, capsys, observation):
    words = ("--format", "lerobot", "--planner", "random", "--observation", observation)
    assert record(tmp_path, *words, "--episodes", 2, "--steps", 4, "--seed", 7) == 0
    assert "LeRobotDataset('random-v0'" in capsys.readouterr().out
    info, _, episodes = rows_of(tmp_path / "random-v0")
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"]) == (2, 8)
    assert info["robot_type"] == "free"
    tasks = pd.read_parquet(tmp_path / "random-v0/meta/tasks.parquet")
    assert tasks.iloc[0].name.startswith("2 episodes of random in MSActiveSLAM-FreeCamera-v0")
    for seed, rows in enumerate(episodes, start=7):
        happened = list(replayed(seed, observation))
        assert len(happened) == len(rows) == 4
        for k, (row, (seen, action, reward, mask, done)) in enumerate(
            zip(rows, happened, strict=True)
        ):
            assert row["frame_index"] == k
            assert row["timestamp"] == pytest.approx(k / info["fps"])
            assert row["action"] == action
            assert row["next.reward"] == np.float32(reward)
            assert row["next.done"] == done
            assert row["info.action_mask"] == mask.tolist()
            if observation == "features":
                np.testing.assert_array_equal(np.float32(row["observation.state"]), seen)
                continue
            np.testing.assert_array_equal(np.float32(row["observation.state"]), seen["state"])
            if observation == "images":  # of four channels, which LeRobot has no image for
                np.testing.assert_array_equal(row["observation.image"], seen["image"].ravel())
                continue
            image = Image.open(io.BytesIO(row["observation.images.color"]["bytes"]))
            np.testing.assert_array_equal(image, seen["color"])
            depth = np.reshape(np.float32(row["observation.depth"]), (60, 80))
            np.testing.assert_array_equal(depth, seen["depth"][..., 0])


def played(length):
    """An episode of nothing in particular."""
    return Steps(
        {"color": RNG.integers(0, 255, (length + 1, 6, 8, 3), dtype=np.uint8)},
        {"pose_error": RNG.random(length + 1)},
        RNG.integers(0, 49, (length, 2)),
        RNG.normal(size=length),
        np.zeros(length, bool),
        np.arange(length) == length - 1,
    )


def test_files_are_divided_and_numbers_summed_up(tmp_path, monkeypatch):
    monkeypatch.setattr("ms_slam_env.env.lerobot_dataset._FILE_MB", 0)  # a file an episode
    monkeypatch.setattr("ms_slam_env.env.lerobot_dataset._FILES_A_CHUNK", 2)
    given = [played(length) for length in (3, 5, 2)]
    writer = DatasetWriter(tmp_path, "look about", 10, "free")
    for steps in given:
        writer.add(steps)
    writer.close()
    assert sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.glob("data/*/*")) == [
        "data/chunk-000/file-000.parquet",
        "data/chunk-000/file-001.parquet",
        "data/chunk-001/file-000.parquet",
    ]
    info, episodes, rows = rows_of(tmp_path)
    assert info["features"]["observation.images.color"]["shape"] == [6, 8, 3]
    assert info["features"]["action"] == {"dtype": "int64", "shape": [2], "names": None}
    assert [row["action"] for own in rows for row in own] == np.concatenate(
        [steps.actions for steps in given]
    ).tolist()
    stats = json.loads((tmp_path / "meta/stats.json").read_text())
    rewards = np.concatenate([steps.rewards for steps in given]).astype(np.float32)
    assert stats["next.reward"]["mean"] == pytest.approx([rewards.mean()], rel=1e-5)
    assert stats["next.reward"]["std"] == pytest.approx([rewards.std()], rel=1e-5)
    assert stats["next.reward"]["max"] == pytest.approx([rewards.max()])
    assert stats["next.reward"]["count"] == [10]
    colors = np.concatenate([steps.observations["color"][:-1] for steps in given]) / 255
    found = stats["observation.images.color"]
    np.testing.assert_allclose(np.squeeze(found["mean"]), colors.mean(axis=(0, 1, 2)))
    np.testing.assert_allclose(np.squeeze(found["std"]), colors.std(axis=(0, 1, 2)))
    first = given[0].observations["color"][:-1] / 255
    np.testing.assert_allclose(
        np.squeeze(episodes[0]["stats/observation.images.color/min"]), first.min(axis=(0, 1, 2))
    )


def test_without_its_library_nothing_is_begun(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ms_slam_env.cli.record.find_spec", lambda name: None)
    assert main(["record", "--format", "lerobot", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "ms-slam record --format lerobot needs pyarrow: pip install" in error
    assert not (tmp_path / "out").exists()
