"""A batch of environments behind the interface of Stable-Baselines3."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from gymnasium.vector import AutoresetMode
from ms_slam_agents import ppo, qrdqn, train_sb3
from ms_slam_agents.batched_venv import BatchedVecEnv
from ms_slam_agents.policy_file import read_policy
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.vec_env import DummyVecEnv

from ms_slam_env.errors import InputError

FREE = "MSActiveSLAM-FreeCamera-v0"
OPTIONS: dict[str, Any] = {
    "scene": ("table", "wall"),
    "num_scene_seeds": 1,
    "image_size": "80x60",
    "max_episode_steps": 3,
}


def make_batch(**more: Any) -> BatchedVecEnv:
    given = {"autoreset_mode": AutoresetMode.SAME_STEP, **OPTIONS, **more}
    return BatchedVecEnv(gym.make_vec(f"batched/{FREE}", num_envs=2, **given))


def test_it_does_what_environments_in_turn_do() -> None:
    batch = make_batch()
    alone = DummyVecEnv([lambda: gym.make(FREE, disable_env_checker=True, **OPTIONS)] * 2)
    for venv in (batch, alone):
        venv.seed(5)
    np.testing.assert_allclose(batch.reset(), alone.reset(), atol=1e-5)
    rng, ended = np.random.default_rng(0), 0
    for _ in range(7):
        masks = get_action_masks(batch)
        np.testing.assert_array_equal(masks, get_action_masks(alone))
        actions = np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])
        ours, theirs = batch.step(actions), alone.step(actions)
        for one, other in zip(ours[:3], theirs[:3], strict=True):
            np.testing.assert_allclose(one, other, atol=1e-5)
        for info, expected in zip(ours[3], theirs[3], strict=True):
            assert info["reward_terms"] == pytest.approx(expected["reward_terms"], abs=1e-5)
            np.testing.assert_array_equal(info["action_mask"], expected["action_mask"])
            assert ("terminal_observation" in info) == ("terminal_observation" in expected)
            if "terminal_observation" in info:
                ended += 1
                assert info["TimeLimit.truncated"] is expected["TimeLimit.truncated"] is True
                last = info["terminal_observation"]
                np.testing.assert_allclose(last, expected["terminal_observation"], atol=1e-5)
    assert ended == 4
    assert is_masking_supported(batch)
    assert batch.env_is_wrapped(gym.Wrapper) == [False, False]
    with pytest.raises(InputError, match="the environments of a batch are one"):
        batch.set_attr("config", None)
    batch.close()
    alone.close()


def test_episodes_that_restart_later_are_refused() -> None:
    with pytest.raises(InputError, match="must be SameStep for Stable-Baselines3"):
        make_batch(autoreset_mode=AutoresetMode.NEXT_STEP)


ROLLOUTS = "--n-steps 8 --batch-size 8 --n-epochs 1"
REPLAY = "--buffer-size 50 --learning-starts 4 --batch-size 4"


@pytest.mark.parametrize(
    ("train", "own"),
    [
        (ppo.main, ROLLOUTS),
        (train_sb3.main, ROLLOUTS),
        (train_sb3.main, f"--algorithm dqn {REPLAY}"),
        (qrdqn.main, REPLAY),
    ],
)
def test_a_batch_trains_a_policy(train: Any, own: str, tmp_path: Path) -> None:
    words = "--batched cpu --scenes table --scene-seeds 1 --episode-steps 4 --image-size 80x60 "
    words += f"--total-timesteps 16 --num-envs 2 --eval-episodes 2 --eval-every 0 {own}"
    assert train([*words.split(), "--out", str(tmp_path)]) == 0
    assert read_policy(tmp_path / "latest.safetensors").metadata.timesteps == 16


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--also arm-kinematic", "a batch has no also; --also without a name"),
        ("--env-id MSActiveSLAM-v0", "unknown environment in a batch 'MSActiveSLAM-v0'"),
        ("--observation map", "in a batch observation must be 'features', not 'map'"),
    ],
)
def test_what_a_batch_does_not_have_is_one_line(
    words: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--batched", "cpu", "--scenes", "table", "--scene-seeds", "1", *words.split()]
    assert ppo.main([*given, "--out", str(tmp_path / "run")]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert said in last
    assert not (tmp_path / "run").exists()
