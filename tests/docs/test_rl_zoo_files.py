"""The hyperparameters for rl-zoo: for which ids, whose values, and that they train."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

import ms_slam_env

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "examples" / "rl_zoo"
FILES = {path.stem: yaml.safe_load(path.read_text()) for path in sorted(FOLDER.glob("*.yml"))}
ONE_ACTION = [env_id for env_id in ms_slam_env.ENV_IDS if "Adaptive" not in env_id]
IDS = {
    "ppo": [*ms_slam_env.ENV_IDS, *ms_slam_env.TASK_IDS],
    "dqn": [*ONE_ACTION, *ms_slam_env.TASK_IDS],
    "sac": list(ms_slam_env.CONTINUOUS_IDS),
}


def test_each_id_has_hyperparameters_for_its_actions() -> None:
    assert {name: list(content) for name, content in FILES.items()} == IDS


def test_those_of_ppo_are_the_options_of_the_command() -> None:
    trainers = pytest.importorskip("ms_slam_agents.trainers")
    own = trainers.Sb3Args()
    options = ("n_steps", "batch_size", "n_epochs", "learning_rate", "gamma", "gae_lambda")
    options += ("ent_coef", "clip_range")
    for given in FILES["ppo"].values():
        assert {name: given[name] for name in options} == {
            name: getattr(own, name) for name in options
        }
        assert given["n_envs"] == own.num_envs
        assert given["policy_kwargs"] == f"dict(net_arch=[{own.hidden}, {own.hidden}])"
        assert given.keys() - options == {"policy", "n_timesteps", "n_envs", "policy_kwargs"}


def of_zoo(name: str, env_id: str) -> tuple[dict[str, Any], int]:
    """Arguments of the model, and the number of environments, as rl-zoo reads them."""
    given = dict(FILES[name][env_id])
    given["policy_kwargs"] = eval(given.get("policy_kwargs", "dict()"))
    assert given.pop("n_timesteps") > 0
    return given, given.pop("n_envs", 1)


@pytest.mark.parametrize("name", sorted(IDS))
def test_they_train(name: str) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    env_util = pytest.importorskip("stable_baselines3.common.env_util")
    env_id = next(one for one in IDS[name] if "Room" in one)
    given, count = of_zoo(name, env_id)
    small = {"n_steps": 32, "batch_size": 32} if name == "ppo" else {"learning_starts": 32}
    options = {"scene": "table", "num_scene_seeds": 1, "image_size": "80x60"}
    venv = env_util.make_vec_env(env_id, count, env_kwargs=options)
    model = getattr(sb3, name.upper())(env=venv, device="cpu", seed=0, **{**given, **small})
    before = model.policy.state_dict()
    before = {key: value.clone() for key, value in before.items()}
    model.learn(64)
    assert model.num_timesteps == 64
    assert any((model.policy.state_dict()[key] != value).any() for key, value in before.items())
