"""Environments in a batch do what each does alone: starts, masks, frames, poses, rewards, ends."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import ms_slam_env
from ms_slam_env._runtime.warp import wp
from ms_slam_env.env.batched.batched_env import BatchedActiveSlam
from ms_slam_env.errors import InputError
from ms_slam_env.gym_ids import BATCHED_IDS

FREE, ROOM = "MSActiveSLAM-FreeCamera-v0", "MSActiveSLAM-Room-v0"
SMALL: dict[str, Any] = {"image_size": "80x60", "num_scene_seeds": 1}
TWO = {**SMALL, "scene": ("table", "wall")}


def batch_of(env_id: str, num_envs: int, **options: Any) -> BatchedActiveSlam:
    env = gym.make_vec(f"batched/{env_id}", num_envs=num_envs, **options)
    assert isinstance(env, BatchedActiveSlam)
    return env


class Alone:
    """The same environments made one by one, each reset by the step after its last."""

    def __init__(self, env_id: str, num_envs: int, **options: Any) -> None:
        self.envs = [gym.make(env_id, disable_env_checker=True, **options) for _ in range(num_envs)]
        self.ended = [False] * num_envs

    def reset(self, seed: int) -> list[tuple[Any, ...]]:
        started = [env.reset(seed=seed + i) for i, env in enumerate(self.envs)]
        return [(one, 0.0, False, False, info) for one, info in started]

    def step(self, actions: Sequence[int]) -> list[tuple[Any, ...]]:
        steps: list[tuple[Any, ...]] = []
        for env, action, ended in zip(self.envs, actions, self.ended, strict=True):
            if ended:
                observation, info = env.reset()
                steps.append((observation, 0.0, False, False, info))
            else:
                steps.append(env.step(int(action)))
        self.ended = [step[2] or step[3] for step in steps]
        return steps


def assert_agrees(batch: tuple[Any, ...], alone: list[tuple[Any, ...]]) -> None:
    """Compare a step of a batch with those of its environments alone."""
    observation, reward, terminated, truncated, info = batch
    each = list(zip(*alone, strict=True))
    infos = each[4]
    assert terminated.tolist() == list(each[2])
    assert truncated.tolist() == list(each[3])
    np.testing.assert_allclose(reward, each[1], rtol=0, atol=1e-5)
    np.testing.assert_allclose(observation, np.stack(each[0]), rtol=0, atol=1e-5)
    compared = {key: [one[key] for one in infos] for key in infos[0] if key != "reward_terms"}
    for key in ("action_mask", "tracking_ok", "scene", "scene_seed", "submap", "T_world_camera"):
        np.testing.assert_array_equal(info[key], compared.pop(key), err_msg=key)
    np.testing.assert_allclose(
        info["T_world_camera_estimate"][:, :3, 3],
        np.stack(compared.pop("T_world_camera_estimate"))[:, :3, 3],
        rtol=0,
        atol=1e-4,
    )
    np.testing.assert_allclose(info["pose_covariance"], compared.pop("pose_covariance"), rtol=1e-3)
    for key, values in compared.items():
        np.testing.assert_allclose(info[key], values, rtol=0, atol=1e-5, err_msg=key)
    for env, one in enumerate(infos):
        for name, term in one["reward_terms"].items():
            assert info["reward_terms"][name][env] == pytest.approx(term, abs=1e-5)
            assert info["reward_terms"][f"_{name}"][env]


def run_beside(
    env_id: str, num_envs: int, steps: int, blocked: float, **options: Any
) -> dict[str, int]:
    """Compare random steps, a share of them blocked where anything is; count what happened."""
    batch, alone = batch_of(env_id, num_envs, **options), Alone(env_id, num_envs, **options)
    batched = (*batch.reset(seed=3),)
    nothing = np.zeros(num_envs), *(np.zeros(num_envs, dtype=bool) for _ in range(2))
    assert_agrees((batched[0], *nothing, batched[1]), alone.reset(seed=3))
    rng, info = np.random.default_rng(0), batched[1]
    seen = {"blocked": 0, "ended": 0, "lost": 0}
    for _ in range(steps):
        wanted = info["action_mask"] ^ (rng.random(num_envs) < blocked)[:, None]
        wanted[~wanted.any(axis=1)] = True
        actions = np.array([rng.choice(np.flatnonzero(each)) for each in wanted])
        step = batch.step(actions)
        assert_agrees(step, alone.step(actions))
        info = step[4]
        seen["blocked"] += int((info["reward_terms"].get("blocked", np.zeros(1)) < 0).sum())
        seen["ended"] += int((step[2] | step[3]).sum())
        seen["lost"] += int((~info["tracking_ok"]).sum())
    batch.close()
    return seen


def test_the_error_terms_of_a_batch_sum_to_the_final_ate() -> None:
    env = batch_of(FREE, 2, **TWO)
    env.reset(seed=0)
    total, rng = np.zeros(2), np.random.default_rng(0)
    for _ in range(6):
        chances = rng.random((2, 49)) * env.action_masks()
        *_, info = env.step(chances.argmax(axis=1))
        total += info["reward_terms"]["ate_growth"]
    assert (info["ate"] > 0).all()
    np.testing.assert_allclose(total, -env.config.reward.ate_growth * info["ate"], rtol=1e-9)
    env.close()


@pytest.mark.parametrize("num_envs", [1, 4])
def test_a_batch_does_what_each_environment_does_alone(num_envs: int) -> None:
    """Through ends of episodes, losses, blocked motions, and resets into other scenes."""
    options = {**TWO, "step_m": 0.25, "step_rad": 0.4, "lost_patience": 2, "max_episode_steps": 13}
    options["episodes_per_scene"] = 2
    seen = run_beside(FREE, num_envs, 30, 0.3, **options)
    assert seen["ended"] >= 2 * num_envs
    if num_envs > 1:
        assert min(seen.values()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", [1, 4])
def test_the_room_task_in_a_batch_is_the_room_task(num_envs: int) -> None:
    """A whole episode at full size, and the beginning of the next."""
    assert run_beside(ROOM, num_envs, 104, 0.1, num_scene_seeds=1)["ended"] >= num_envs


def test_a_reset_in_the_same_step_gives_the_start_that_the_next_step_would() -> None:
    options = {**TWO, "max_episode_steps": 3}
    modes = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP
    later, at_once = (batch_of(FREE, 2, autoreset_mode=mode, **options) for mode in modes)
    assert [env.metadata["autoreset_mode"] for env in (later, at_once)] == list(modes)
    for env in (later, at_once):
        env.reset(seed=0)
        env.reset(seed=[None, 9], options={"reset_mask": np.array([False, True])})
    # Environment 0 is one step ahead, so that it ends while the other goes on.
    for env in (later, at_once):
        env.step(np.array([1, 1]))
        env.reset(seed=[None, 9], options={"reset_mask": np.array([False, True])})
    for actions in ([8, 2], [0, 0]):
        ends = later.step(np.array(actions)), at_once.step(np.array(actions))
        np.testing.assert_array_equal(ends[0][1], ends[1][1])
    assert ends[0][3].tolist() == ends[1][3].tolist() == [True, False]
    info = ends[1][4]
    np.testing.assert_array_equal(info["final_obs"][0], ends[0][0][0])
    assert info["final_obs"][1] is None
    assert info["_final_info"].tolist() == [True, False]
    assert info["final_info"]["pose_error"][0] == ends[0][4]["pose_error"][0]
    # What the ended one starts with; the other moves on in one of the two alone.
    started = later.step(np.array([5, 0]))
    np.testing.assert_array_equal(started[0][0], ends[1][0][0])
    np.testing.assert_array_equal(started[4]["T_world_camera"][0], info["T_world_camera"][0])
    assert started[1][0] == 0
    np.testing.assert_array_equal(ends[0][0][1], ends[1][0][1])
    # From here both have the same to do, and SLAM has the same maps.
    one, other = later.step(np.array([8, 0])), at_once.step(np.array([8, 0]))
    np.testing.assert_array_equal(one[0][0], other[0][0])
    assert one[1][0] == other[1][0]


def test_every_id_of_a_batch_is_made_like_the_id_of_one() -> None:
    assert (f"batched/{FREE}", f"batched/{ROOM}") == ms_slam_env.BATCHED_IDS
    for env_id in (FREE, ROOM):
        batch, alone = batch_of(env_id, 1), gym.make(env_id, disable_env_checker=True)
        assert batch.config == alone.unwrapped.config  # type: ignore[attr-defined]
        assert batch.spec is not None
        assert alone.spec is not None
        assert batch.spec.max_episode_steps == alone.spec.max_episode_steps
        assert batch.single_observation_space == alone.observation_space
        assert batch.single_action_space == alone.action_space


def test_starts_come_from_a_pool_if_asked_for() -> None:
    env = batch_of(FREE, 6, start_pool=2, **{**SMALL, "scene": "table"})
    poses = [env.reset(seed=seed)[1]["T_world_camera"] for seed in (0, 0, 100)]
    np.testing.assert_array_equal(poses[0], poses[1])
    assert len(np.unique(np.concatenate(poses).reshape(-1, 16), axis=0)) == 2
    with pytest.raises(InputError, match="start_pool"):
        batch_of(FREE, 1, start_pool=-1)


def test_masks_are_had_as_sb3_contrib_asks_for_them() -> None:
    env = batch_of(FREE, 2, step_m=1.0, **TWO)
    _, info = env.reset(seed=1)
    masks = env.get_attr("action_masks")
    assert len(masks) == 2
    np.testing.assert_array_equal(masks, info["action_mask"])
    np.testing.assert_array_equal(env.call("action_masks"), masks)
    assert not np.all(masks)
    with pytest.raises(InputError, match="only action_masks"):
        env.call("reset")


def test_an_episode_must_be_reset_by_hand_if_nothing_else_does() -> None:
    env = batch_of(FREE, 1, autoreset_mode="Disabled", max_episode_steps=1, **TWO)
    with pytest.raises(InputError, match="must be reset"):
        env.step([0])
    env.reset(seed=0)
    assert env.step([0])[3].all()
    with pytest.raises(InputError, match=r"episodes of \[0\] have ended"):
        env.step([0])
    env.reset()
    env.step([0])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"observation": "rgbd"}, "observation must be 'features', not 'rgbd'"),
        ({"frames_per_action": 3}, "frames_per_action must be 1"),
        ({"slam": "odometry"}, "slam must be surfel"),
        ({"slam_config": {"submaps": "atlas"}}, "slam_config.submaps must be 'off'"),
        ({"embodiment": "arm"}, "embodiment must be free"),
        ({"task": "disturbed"}, "no perturbations"),
        ({"device": "tpu"}, "unknown device 'tpu'; valid choices: cpu"),
        ({"autoreset_mode": "never"}, "valid choices: NextStep, SameStep, Disabled"),
        ({"num_env": 3}, "unknown option of the environment 'num_env'"),
    ],
)
def test_what_a_batch_does_not_have_is_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        batch_of(FREE, 1, **options)


@pytest.mark.parametrize("make", [gym.make, partial(gym.make_vec, vectorization_mode="sync")])
@pytest.mark.parametrize("batched_id", BATCHED_IDS)
def test_what_cannot_make_a_batch_says_what_can(make: Any, batched_id: str) -> None:
    with pytest.raises(InputError, match=r"gym\.make_vec\(ID, num_envs=N\), without a vector"):
        make(batched_id)


def test_bad_actions_and_resets_are_refused() -> None:
    env = batch_of(FREE, 2, **TWO)
    with pytest.raises(InputError, match="first reset must be of all"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    for actions in ([0], [0, 49], [-1, 0], [0.5, 0], [[0, 0]]):
        with pytest.raises(InputError, match="actions"):
            env.step(np.array(actions))
    with pytest.raises(InputError, match="reset_mask"):
        env.reset(options={"reset_mask": np.zeros(2, dtype=bool)})
    with pytest.raises(InputError, match="seed"):
        env.reset(seed=[1])
    outside = np.eye(4)
    outside[:3, 3] = 100.0
    with pytest.raises(InputError, match="environment 0 cannot start"):
        env.reset(options={"T_world_camera": outside})
    with pytest.raises(InputError, match="must be reset"):
        env.step([0, 0])


@pytest.mark.parametrize(
    ("name", "least"),
    [
        ("env.batched.kernels", 4),
        ("sensor.camera_batch", 2),
        ("sensor.shading", 2),
        ("sensor.depth_noise", 2),
        ("divergence.kernels", 4),
    ],
)
def test_kernels_compile_for_a_gpu(name: str, least: int, tmp_path: Path) -> None:
    """As `test_cuda_code` has it of SLAM's; nothing here needs a GPU."""
    module = import_module(f"ms_slam_env.{name}")
    wp.compile_aot_module(module, arch=90, module_dir=str(tmp_path), use_ptx=True)
    [file] = tmp_path.glob("*.ptx")
    assert file.read_text().count(".entry") >= least
