"""Paths at a stated pace, closed paths, and recorded motions placed into a scene."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, make_pose, relative_angle, se3_exp, so3_exp
from ms_slam_env.sequences import HandheldPath, place_trajectory
from ms_slam_env.sequences.paths.placement import upright

TREMOR_M = np.sqrt(3) * 2 * np.pi * 0.13 * 0.002  # an upper bound a frame


def steps_m(poses: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)


def turns_deg(poses: np.ndarray) -> np.ndarray:
    R = poses[:, :3, :3]
    return np.degrees([relative_angle(a, b) for a, b in itertools.pairwise(R)])


@pytest.mark.parametrize("seed", range(2))
def test_pace_and_limits(box_scene: BoxScene, seed: int) -> None:
    path = HandheldPath(frames=200, rate_hz=20, speed_m_s=0.5, turn_deg_s=25, variation=0.3)
    poses = path.poses(box_scene, seed)
    assert poses.shape == (200, 4, 4)
    np.testing.assert_allclose(np.diff(path.timestamps), 1 / 20)
    limit_m, limit_deg = 1.3 * 0.5 / 20, 1.3 * 25 / 20
    assert steps_m(poses).max() <= limit_m + TREMOR_M
    assert turns_deg(poses).max() <= 1.3 * limit_deg
    # At every instant one of the two speeds is near what the pace permits.
    used = np.maximum(steps_m(poses) / (0.5 / 20), turns_deg(poses) / (25 / 20))
    assert np.mean(used) == pytest.approx(1.0, abs=0.2)
    assert box_scene.clearance(poses[:, :3, 3]).min() > 0.1
    np.testing.assert_array_equal(poses, path.poses(box_scene, seed))
    assert not np.allclose(poses, path.poses(box_scene, seed + 10))


def test_the_largest_step_is_kept(box_scene: BoxScene) -> None:
    path = HandheldPath(100, 30, 3.0, 300.0, 0.5, max_step_m=0.03, max_turn_deg=2.0)
    poses = path.poses(box_scene, 0)
    assert 0.02 < steps_m(poses).max() <= 0.03 + TREMOR_M
    assert 1.5 < turns_deg(poses).max() <= 2.0 * 1.3


@pytest.mark.parametrize("seed", range(2))
def test_a_loop_comes_back(box_scene: BoxScene, seed: int) -> None:
    poses = HandheldPath(500, speed_m_s=0.6, turn_deg_s=45, loop=True).poses(box_scene, seed)
    assert poses.shape == (500, 4, 4)
    assert np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]) < 0.01
    assert np.degrees(relative_angle(poses[0, :3, :3], poses[-1, :3, :3])) < 1
    headings = np.unwrap(np.arctan2(poses[:, 1, 2], poses[:, 0, 2]))
    assert abs(headings[-1] - headings[0]) == pytest.approx(2 * np.pi, abs=0.03)
    assert steps_m(poses).max() <= 1.3 * 0.6 / 30 + TREMOR_M
    assert turns_deg(poses).max() <= 1.3 * 1.3 * 45 / 30
    assert box_scene.clearance(poses[:, :3, 3]).min() > 0.1
    away = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    assert away.max() > 0.4


def test_many_frames_go_round_several_times(box_scene: BoxScene) -> None:
    path = HandheldPath(1500, speed_m_s=1.0, turn_deg_s=90, loop=True, variation=0.0)
    fast = dataclasses.replace(path, max_step_m=1.0, max_turn_deg=90.0)
    poses = fast.poses(box_scene, 1)
    headings = np.unwrap(np.arctan2(poses[:, 1, 2], poses[:, 0, 2]))
    rounds = abs(headings[-1] - headings[0]) / (2 * np.pi)
    assert rounds > 1.5
    assert rounds == pytest.approx(round(rounds), abs=0.01)
    assert np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]) < 0.01


def test_a_loop_too_short_says_what_it_takes(box_scene: BoxScene) -> None:
    with pytest.raises(InputError, match=r"takes at least 361 frames at this pace, not 20"):
        HandheldPath(20, loop=True).poses(box_scene, 0)


@pytest.mark.parametrize(
    "options", [{"frames": 1}, {"rate_hz": 0}, {"speed_m_s": float("nan")}, {"variation": 1.0}]
)
def test_bad_options_are_refused(options: dict) -> None:
    with pytest.raises(InputError, match=f"HandheldPath.{next(iter(options))}"):
        HandheldPath(**options)


def recording(rng: np.random.Generator, up: np.ndarray, extent_m: float) -> np.ndarray:
    """Level cameras in a world whose up is ``up``, within ``extent_m``."""
    poses = []
    for _ in range(30):
        z = np.cross(up, rng.normal(size=3))
        z /= np.linalg.norm(z)
        R = np.stack([np.cross(-up, z), -up, z], axis=1) @ so3_exp(rng.normal(0, 0.1, 3))
        poses.append(make_pose(R, rng.uniform(-0.5, 0.5, 3) * extent_m + 7.0))
    return np.stack(poses)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_placed_motion_is_the_same_motion(box_scene: BoxScene, axis: int, sign: float) -> None:
    up = np.zeros(3)
    up[axis] = sign
    given = recording(np.random.default_rng(axis), up, 1.0)
    np.testing.assert_allclose(upright(given) @ up, [0, 0, 1], atol=1e-12)
    assert np.linalg.det(upright(given)) == pytest.approx(1.0)
    placed = place_trajectory(box_scene, given, seed=3)
    assert placed.scale == 1.0
    assert box_scene.clearance(placed.poses[:, :3, 3]).min() > 0.15
    assert -placed.poses[:, 2, 1].mean() > 0.95  # the cameras' up is the scene's
    relative = invert(given[:-1]) @ given[1:]
    np.testing.assert_allclose(invert(placed.poses[:-1]) @ placed.poses[1:], relative, atol=1e-9)
    np.testing.assert_allclose(placed.T_scene_recording @ given, placed.poses, atol=1e-9)
    again = place_trajectory(box_scene, given, seed=3)
    np.testing.assert_array_equal(again.poses, placed.poses)


def test_a_large_motion_is_scaled_until_it_fits(box_scene: BoxScene) -> None:
    given = recording(np.random.default_rng(0), np.array([0.0, 0.0, 1.0]), 3.0)
    placed = place_trajectory(box_scene, given)
    assert 0.1 <= placed.scale < 1.0
    a = np.linalg.norm(np.diff(given[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps_m(placed.poses), placed.scale * a)
    with pytest.raises(InputError, match=r"fits nowhere into scene 'box', seed 0, at scale 3"):
        place_trajectory(box_scene, given, scale=3.0)


@pytest.mark.parametrize(
    ("poses", "options", "message"),
    [
        (np.zeros((0, 4, 4)), {}, "shape"),
        (np.full((2, 4, 4), np.nan), {}, "pose 0 of the trajectory"),
        (se3_exp([0, 0, 0, 0, 0, 0])[None], {"scale": -1.0}, "scale = -1.0"),
    ],
)
def test_bad_motions_are_refused(box_scene: BoxScene, poses, options, message) -> None:
    with pytest.raises(InputError, match=message):
        place_trajectory(box_scene, poses, **options)
