"""Archives of Stable-Baselines3 become policy files; nothing in them is executed."""

import base64
import json
import pickle
import zipfile

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from learnable_fake import ENV_ID
from ms_slam_agents import train_sb3
from ms_slam_agents.policy_file import read_policy
from ms_slam_agents.sb3_state import ALGORITHMS, tensors_of
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from test_policy_file import Trap

OPTIONS = {"n_steps": 32, "batch_size": 16, "policy_kwargs": {"net_arch": [16, 16]}}


class TwoNumbers(gym.Wrapper):
    """Actions of two numbers, as where a SLAM configuration is chosen too."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = gym.spaces.MultiDiscrete([7, 3])

    def step(self, action):
        return self.env.step(action[0])

    def action_masks(self):
        return np.concatenate([self.env.unwrapped.action_masks(), np.ones(3, dtype=bool)])


def make_archive(folder, parts=(7,), algorithm="maskable_ppo", more=None):
    """As the training script wrote it before there was a format of its own."""

    def make():
        env = gym.make(ENV_ID, max_episode_steps=10)
        return TwoNumbers(env) if len(parts) > 1 else env

    venv = VecNormalize(DummyVecEnv([make]))
    model = ALGORITHMS[algorithm]("MlpPolicy", venv, seed=0, device="cpu", **OPTIONS).learn(64)
    path = folder / "old.zip"
    model.save(path)
    description = {
        "algorithm": algorithm,
        "env_id": ENV_ID,
        "observation": "features",
        "timesteps": 64,
        "minutes": 0.5,
        "options": {"env_id": ENV_ID, "hidden": 16, "step_deg": 90.0, "eval_episodes": 3},
    }
    for name, running in (("observation", venv.obs_rms), ("return", venv.ret_rms)):
        description[f"{name}_moments"] = {
            "mean": running.mean.tolist(),
            "var": running.var.tolist(),
            "count": float(running.count),
        }
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("ms_slam_env.json", json.dumps(description | (more or {})))
    return path, model


def convert(path, *words):
    out = path.parent / "new.safetensors"
    return train_sb3.main(["convert", str(path), "--out", str(out), *words]), out


@pytest.mark.parametrize("algorithm", ["maskable_ppo", "ppo"])
@pytest.mark.parametrize("parts", [(7,), (7, 3)])
def test_every_number_of_the_model_is_in_the_new_file(tmp_path, parts, algorithm):
    path, model = make_archive(tmp_path, parts, algorithm)
    status, out = convert(path, "--trust")
    assert status == 0
    found = read_policy(out)
    expected = tensors_of(model)
    assert found.tensors.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(found.tensors[name], value, err_msg=name)
    assert found.metadata.actions == parts
    assert (found.metadata.timesteps, found.metadata.epochs) == (64, model._n_updates)
    assert found.metadata.env_options == {"step_rad": pytest.approx(np.pi / 2)}


def test_without_the_optimiser_it_is_smaller(tmp_path):
    path, _ = make_archive(tmp_path)
    _, out = convert(path, "--trust")
    size = out.stat().st_size
    assert convert(path, "--trust", "--no-optimizer")[0] == 0
    assert not read_policy(out).can_resume
    assert out.stat().st_size < size


def test_an_archive_is_not_converted_without_trust(tmp_path, capsys):
    path, _ = make_archive(tmp_path)
    status, out = convert(path)
    assert status == 2
    assert "add --trust" in capsys.readouterr().err
    assert not out.exists()


def test_a_pickle_under_an_extra_key_is_not_executed(tmp_path):
    path, _ = make_archive(tmp_path)
    trap = base64.b64encode(pickle.dumps(Trap(tmp_path / "sprung"))).decode()
    rewritten = tmp_path / "trap.zip"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(rewritten, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "data":
                data = json.loads(content) | {"extra": {":type:": "x", ":serialized:": trap}}
                content = json.dumps(data).encode()
            new.writestr(name, content)
    assert convert(rewritten, "--trust")[0] == 0
    assert not (tmp_path / "sprung").exists()
    ALGORITHMS["maskable_ppo"].load(rewritten)  # what was done before
    assert (tmp_path / "sprung").is_dir()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithm": "dqn"}, "unknown algorithm 'dqn'"),
        ({"options": None}, "no policy of Stable-Baselines3"),
        ({"timesteps": "many"}, "no policy of Stable-Baselines3"),
        ({"observation_moments": {"mean": [0.0], "var": [1.0], "count": 1.0}}, "shape"),
    ],
)
def test_a_broken_archive_gives_one_line(tmp_path, capsys, changes, message):
    path, _ = make_archive(tmp_path, more=changes)
    status, out = convert(path, "--trust")
    error = capsys.readouterr().err
    assert status == 2
    assert message in error
    assert len(error.strip().splitlines()) == 1
    assert not out.exists()
