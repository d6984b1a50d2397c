"""Spaces: masks of ``info`` sample from them, observations keep their bounds, names are right."""

from itertools import product

import gymnasium as gym
import numpy as np
import pytest

import ms_slam_env
from ms_slam_env.env import STATE_NAMES
from ms_slam_env.env.actions import MaskedDiscrete, MaskedMultiDiscrete
from ms_slam_env.env.registry import OBSERVATIONS
from ms_slam_env.geometry import invert
from ms_slam_env.robot import ROTATIONS, TRANSLATIONS

OPTIONS = {"scene": "table", "scene_seed": 0, "image_size": "80x60"}
OTHER_IDS = [one for one in ms_slam_env.ENV_IDS if one != "MSActiveSLAM-FreeCamera-v0"]


@pytest.mark.parametrize(
    ("env_id", "observation"),
    [
        *(("MSActiveSLAM-FreeCamera-v0", name) for name in OBSERVATIONS),
        *product(OTHER_IDS, ("rgbd", "held", "candidates")),
    ],
)
def test_random_episodes_keep_to_finite_bounds(env_id, observation):
    env = gym.make(env_id, observation=observation, **OPTIONS)
    for space in gym.spaces.Dict({"all": env.observation_space}).values():
        for part in space.values() if isinstance(space, gym.spaces.Dict) else (space,):
            assert part.is_bounded()
    seen, info = env.reset(seed=1)
    env.action_space.seed(1)
    for _ in range(6):
        assert seen in env.observation_space
        seen, _, _, _, info = env.step(env.action_space.sample(mask=info["action_mask"]))


@pytest.mark.parametrize("env_id", ms_slam_env.ENV_IDS)
def test_the_mask_of_info_samples_possible_actions(env_id):
    env = gym.make(env_id, **OPTIONS)
    _, info = env.reset(seed=0)
    env.action_space.seed(0)
    mask = info["action_mask"].copy()
    n = env.unwrapped.simulation.embodiment_type.num_motions
    mask[:n] = False
    mask[[2, 5]] = True
    drawn = {int(np.ravel(env.action_space.sample(mask=mask))[0]) for _ in range(60)}
    assert drawn == {2, 5}


def test_masks_of_gymnasiums_own_form_still_sample():
    one, two = MaskedDiscrete(3), MaskedMultiDiscrete([2, 3])
    parts = np.array([0, 1], np.int8), np.array([0, 0, 1], np.int8)
    assert one.sample(mask=parts[1]) == 2
    assert two.sample(mask=parts).tolist() == [1, 2]
    assert two.sample(mask=np.concatenate(parts).astype(bool)).tolist() == [1, 2]
    with pytest.raises(AssertionError):
        one.sample(mask=np.ones(4, dtype=bool))


def test_state_names_say_what_the_numbers_are():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", **OPTIONS)
    seen, info = env.reset(seed=0)
    first = info["T_world_camera_estimate"]
    action = next(a for a in (36, 22, 8) if info["action_mask"][a])
    seen, _, _, _, info = env.step(action)
    state = dict(zip(env.unwrapped.state_names, seen[: len(STATE_NAMES)], strict=True))
    moved = invert(first) @ info["T_world_camera_estimate"]
    for row, axis in enumerate("xyz"):
        assert state[axis] == pytest.approx(moved[row, 3] / 5, abs=1e-6)
        assert state[f"R_{axis}x"] == pytest.approx(moved[row, 0], abs=1e-6)
        assert state[f"R_{axis}y"] == pytest.approx(moved[row, 1], abs=1e-6)
    maxima = env.unwrapped.config.targets.maxima
    divergences = state["intensity_divergence"], state["depth_divergence"]
    np.testing.assert_allclose(divergences, info["divergence"] / maxima, rtol=1e-5)
    assert state["tracking_ok"] == info["tracking_ok"]
    assert state["inlier_fraction"] == pytest.approx(env.unwrapped.episode.inlier_fraction)
    assert state["lost_share"] == 0
    hot = [name for name in STATE_NAMES if "tation_" in name or "translation_" in name]
    translation, rotation = TRANSLATIONS[action // 7], ROTATIONS[action % 7].replace(" ", "_")
    expected = {f"translation_{translation}", f"rotation_{rotation}"}
    assert {name for name in hot if state[name] == 1} == expected
    assert sum(state[name] for name in hot) == 2


def test_covariance_is_slams_and_infinite_where_there_is_none():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", **OPTIONS)
    _, info = env.reset(seed=0)
    np.testing.assert_array_equal(info["pose_covariance"], np.diag(np.full(6, np.inf)))
    env.unwrapped.slam.track, kept = _remembering(env.unwrapped.slam.track)
    _, _, _, _, info = env.step(1)
    np.testing.assert_array_equal(info["pose_covariance"], kept[-1].covariance)
    np.testing.assert_array_equal(info["pose_covariance"], env.unwrapped.episode.pose_covariance)
    assert (np.linalg.eigvalsh(info["pose_covariance"]) > 0).all()


def _remembering(track):
    kept = []

    def remember(*arguments):
        kept.append(track(*arguments))
        return kept[-1]

    return remember, kept


def test_mapped_share_is_that_of_the_reachable_voxels():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", pose="ground_truth", **OPTIONS).unwrapped
    _, info = env.reset(seed=0)
    shares = [info["mapped_share"]]
    for _ in range(4):
        _, _, _, _, info = env.step(6)  # turns on the spot
        shares.append(info["mapped_share"])
    assert shares == sorted(shares)
    assert 0 < shares[0] < shares[-1] < 1
    points, _ = env.scene.surface_points(0.0125)
    voxel_m = env.coverage.voxel_m
    origin = env.scene.bounds()[0] - 2 * voxel_m
    voxels = {tuple(cell) for cell in np.floor((points - origin) / voxel_m).astype(int)}
    assert info["mapped_area"] / (len(voxels) * voxel_m**2) == pytest.approx(shares[-1], rel=0.15)
