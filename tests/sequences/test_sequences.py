"""Hand-held trajectories and rendered sequences."""

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, relative_angle
from ms_slam_env.sequences import (
    Sequence,
    handheld_trajectory,
    render_sequence,
)

SPEED_M, ROT_DEG = 0.015, 1.0
TREMOR_M = 2 * np.pi * 0.13 * 0.002  # fastest sine at full amplitude, an upper bound a frame


@pytest.mark.parametrize("seed", range(4))
def test_the_camera_moves_smoothly_through_free_space(box_scene: BoxScene, seed: int) -> None:
    poses = handheld_trajectory(box_scene, 220, seed, SPEED_M, ROT_DEG)
    assert poses.shape == (220, 4, 4)
    for T in poses[::20]:
        check_pose(T)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = [
        relative_angle(a, b) for a, b in zip(poses[:-1, :3, :3], poses[1:, :3, :3], strict=True)
    ]
    assert steps.max() <= SPEED_M + np.sqrt(3) * TREMOR_M
    assert np.degrees(max(turns)) <= 1.5 * ROT_DEG
    assert steps.sum() > 1.0
    assert box_scene.clearance(poses[:, :3, 3]).min() > 0.1
    accelerations = np.linalg.norm(np.diff(poses[:, :3, 3], n=2, axis=0), axis=1)
    assert accelerations.max() < SPEED_M


def test_the_seed_decides_the_path(box_scene: BoxScene) -> None:
    first, again, other = (handheld_trajectory(box_scene, 50, seed) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


def test_a_sequence_is_the_same_each_time(box_scene: BoxScene) -> None:
    poses = handheld_trajectory(box_scene, 4, 0)
    first, again = (render_sequence(box_scene, poses, xtion("80x60"), seed=2) for _ in range(2))
    assert len(first) == 4
    assert first.name == "box-0"
    for a, b in zip(first.frames, again.frames, strict=True):
        assert np.array_equal(a.depth, b.depth)
        assert np.array_equal(a.color, b.color)
    assert not np.array_equal(first.frames[0].depth, first.frames[1].depth)


@pytest.mark.parametrize(
    "arguments",
    [{"frames": 1}, {"frames": 20, "speed_m": 0.0}, {"frames": 20, "rot_deg": float("nan")}],
)
def test_bad_arguments_are_refused(box_scene: BoxScene, arguments: dict) -> None:
    with pytest.raises(InputError):
        handheld_trajectory(box_scene, seed=0, **arguments)


def test_a_scene_without_room_is_refused(box_scene: BoxScene, monkeypatch) -> None:
    monkeypatch.setattr(box_scene, "segment_is_free", lambda *_: False)
    with pytest.raises(InputError, match="no free path"):
        handheld_trajectory(box_scene, 10, 0)


def test_a_sequence_needs_a_pose_a_frame() -> None:
    with pytest.raises(InputError, match="0 frames"):
        Sequence((), np.eye(4)[None], xtion("80x60"), "empty")
