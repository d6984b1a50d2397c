"""The motion mask against the renderer's labels, and what SLAM makes of it."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest

from ms_slam_env._runtime.warp import wp
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.sequences import HandheldPath, open_sequence
from ms_slam_env.slam.surfel.backend import SurfelSlam
from ms_slam_env.slam.surfel.free_space_mask import APPEARED, SUPPORTED, VANISHED, store, weigh
from ms_slam_env.slam.surfel.preprocessing import Pieces
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig

MOVING = "living_room:110:kinect+moving-objects,kind=box,count=3"
STILL = "living_room:110:kinect"
FRAMES = 36
CONFIG = SurfelConfig(motion_mask="geometric", max_surfels=60_000)


@lru_cache
def recorded(name: str):
    """Intrinsics, frames, poses and, for each frame, where objects are that move."""
    sequence = open_sequence(name, "160x120", path=HandheldPath(frames=FRAMES))
    moving = [
        index
        for index, label in enumerate(sequence.frames.labels)
        if label.startswith(tuple(sequence.frames.object_trajectories) or "none of them")
    ]
    labels = [np.isin(sequence.frames.truth(k).labels, moving) for k in range(FRAMES)]
    return sequence.intrinsics, list(sequence.frames), sequence.poses, np.array(labels)


def tracked(name: str, config: SurfelConfig):
    """Results of all frames, and the SLAM at the end."""
    intrinsics, frames, poses, _ = recorded(name)
    system = SurfelSlam(intrinsics, config)
    system.reset(poses[0])
    return [system.track(frame) for frame in frames], system


def poses_of(results) -> np.ndarray:
    return np.array([result.T_world_camera for result in results])


@pytest.fixture(scope="module")
def masked():
    return tracked(MOVING, CONFIG)


def test_the_mask_is_what_moves(masked) -> None:
    _, frames, _, labels = recorded(MOVING)
    found = np.array([result.moving for result in masked[0]])[12:]
    step = labels.shape[1] // found.shape[1]
    truth = labels[12:, ::step, ::step]
    seen = np.array([frame.depth for frame in frames])[12:, ::step, ::step] > 0
    assert truth.mean() > 0.03
    both, either = (found & truth & seen).sum(), ((found | truth) & seen).sum()
    assert both / either > 0.6
    assert both / (truth & seen).sum() > 0.85


def test_what_moves_does_not_draw_the_pose_along(masked) -> None:
    poses = recorded(MOVING)[2]
    assert all(result.tracking_ok for result in masked[0])
    assert ate_rmse(poses_of(masked[0]), poses) < 0.004


def test_what_is_near_and_moves_from_the_start_does_not_draw_the_pose_along() -> None:
    """The box fills a quarter of the view and is measured ten times as well as the rest."""
    near = "corridor:1011:kinect+moving-objects,kind=box,count=2"
    sequence = open_sequence(near, "160x120", path=HandheldPath(300))
    system = SurfelSlam(sequence.intrinsics, CONFIG)
    system.reset(sequence.poses[0])
    results = [system.track(sequence.frames[k]) for k in range(6)]
    off = np.linalg.norm((poses_of(results) - sequence.poses[:6])[:, :3, 3], axis=1)
    assert off.max() < 0.01
    assert results[-1].moving.mean() > 0.15


def test_all_is_doubted_at_the_start_and_what_has_been_seen_long_enough_is_not() -> None:
    intrinsics, frames, poses, _ = recorded(STILL)
    system = SurfelSlam(intrinsics, CONFIG)
    system.reset(poses[0])
    doubts = []
    for _ in range(18):
        doubts.append(bool(system._slam.motion_mask.doubts()[0]))
        system.track(frames[0])
    assert doubts == [True] * 13 + [False] * 5
    system.reset(poses[0])
    assert system._slam.motion_mask.doubts()[0]


def test_what_moves_is_not_mapped_and_what_was_is_removed(masked) -> None:
    """The boxes are in view from the first frame on, before they can be known to move."""
    _, _, poses, labels = recorded(MOVING)
    ignored = tracked(MOVING, replace(CONFIG, motion_mask="none"))[1]
    still = open_sequence(STILL, "160x120", path=HandheldPath(frames=FRAMES))
    surface = still.frames.truth(FRAMES - 1).depth

    def in_front(system: SurfelSlam, where: np.ndarray) -> float:
        """Share of the last view in which the map is in front of all that stands still."""
        depth = system.predict(poses[-1:]).depth[0]
        return float(((depth > 0) & (depth < surface - 0.1))[where].mean())

    assert in_front(ignored, labels[-1]) > 0.6
    assert in_front(masked[1], labels[-1]) < 0.4  # there the last frame hides what is left
    assert in_front(masked[1], ~labels[-1]) < 0.05


def test_a_still_scene_has_an_empty_mask_and_the_same_trajectory() -> None:
    results, _ = tracked(STILL, CONFIG)
    without, _ = tracked(STILL, replace(CONFIG, motion_mask="none"))
    assert np.mean([result.moving.mean() for result in results]) < 0.005
    assert all(result.moving is None for result in without)
    poses = recorded(STILL)[2]
    assert ate_rmse(poses_of(results), poses) < 1.05 * ate_rmse(poses_of(without), poses)


def test_a_restored_state_goes_on_bit_exactly(masked) -> None:
    intrinsics, frames, poses, _ = recorded(MOVING)
    first, second = SurfelSlam(intrinsics, CONFIG), SurfelSlam(intrinsics, CONFIG)
    first.reset(poses[0])
    for frame in frames[:17]:
        first.track(frame)
    second.set_state(first.get_state())
    results = [second.track(frame) for frame in frames[17:]]
    np.testing.assert_array_equal(poses_of(results), poses_of(masked[0][17:]))
    for result, expected in zip(results, masked[0][17:], strict=True):
        np.testing.assert_array_equal(result.moving, expected.moving)


def test_envs_of_a_batch_do_not_know_of_each_other(masked) -> None:
    intrinsics, moving, poses, _ = recorded(MOVING)
    _, still, still_poses, _ = recorded(STILL)
    batch = BatchedSurfelSlam(2, intrinsics, CONFIG)
    batch.reset(still_poses[0], 0)
    batch.reset(poses[0], 1)
    for k in range(20):
        pair = still[k], moving[k]
        color = np.stack([frame.color for frame in pair])
        results = batch.track(color, np.stack([frame.depth for frame in pair]))
    np.testing.assert_array_equal(results[1].T_world_camera, masked[0][19].T_world_camera)
    np.testing.assert_array_equal(results[1].moving, masked[0][19].moving)


def test_known_poses_are_masked_too() -> None:
    intrinsics, frames, poses, labels = recorded(MOVING)
    system = SurfelSlam(intrinsics, CONFIG)
    results = [system.fuse(*pair) for pair in zip(frames, poses, strict=True)]
    found = results[-1].moving
    truth = labels[-1][:: labels.shape[1] // len(found), :: labels.shape[1] // len(found)]
    assert (found & truth).sum() > 0.7 * truth.sum()


def corner(height: int = 12, width: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """A wall 2 m away with a box 1 m away before it, in depth and normals."""
    depth = np.full((height, width), 2.0, dtype=np.float32)
    depth[3:8, 4:10] = 1.0
    normals = np.zeros((height, width, 3), dtype=np.float32)
    normals[..., 2] = -1.0
    return depth, normals


def test_pieces_are_cut_at_steps_and_creases() -> None:
    depth, normals = corner()
    normals[:, 13:] = (1.0, 0.0, 0.0)
    pieces = Pieces(depth, normals, 0.05, 0.8)
    inside = {pieces.labels[5, 5], pieces.labels[10, 1], pieces.labels[5, 14]}
    assert len(inside) == 3
    assert 0 not in inside


def test_a_piece_is_filled_where_most_of_it_is_above_the_limit() -> None:
    pieces = Pieces(*corner(), 0.05, 0.8)
    values = np.zeros(pieces.labels.shape, dtype=np.float32)
    values[3:8, 4:7], values[0, :4] = 2.0, 2.0  # most of the box, little of the wall
    box = pieces.labels == pieces.labels[5, 5]
    filled = pieces.filled(values, 0.5)
    assert (filled[box] == 2.0).all()
    np.testing.assert_array_equal(filled[~box], values[~box])


def test_evidence_is_summed_up_as_a_slow_version_does():
    rng = np.random.default_rng(0)
    shape = (3, 11, 14)
    depth = rng.uniform(0.1, 5, shape).astype(np.float32)
    depth[rng.random(shape) < 0.2] = 0
    masked = (rng.random(shape) < 0.1).astype(np.int32)
    found = rng.integers(0, 16, shape).astype(np.int32)
    found[1] &= ~int(APPEARED)
    inputs = [wp.array(values, device="cpu") for values in (depth, masked, found)]
    sums = wp.zeros((*shape[:2], 4), dtype=wp.float64, device="cpu")
    wp.launch(weigh, shape[:2], [*inputs, sums], device="cpu")
    for env, (weights, unseen, appeared, vanished) in enumerate(sums.numpy().sum(axis=1)):
        counts = (depth[env] > 0) & (masked[env] == 0)
        weight = np.maximum(depth[env].astype(float), 0.3) ** -4.0
        is_new = (found[env] & SUPPORTED) == 0
        assert weights == pytest.approx(weight[counts].sum(), rel=1e-6)
        assert unseen == pytest.approx(weight[counts & is_new].sum(), rel=1e-6)
        assert vanished == np.count_nonzero(found[env] & VANISHED)
        has_appeared = (found[env] & APPEARED) > 0
        around = cv2.blur(has_appeared.astype(np.float32), (3, 3)) > 0.3
        assert appeared == np.count_nonzero(has_appeared & around)
        assert (appeared == 0) == (env == 1)


def test_images_are_stored_in_their_slots():
    rng = np.random.default_rng(0)
    depth, nearest = rng.uniform(0.1, 5, (2, 3, 20)).astype(np.float32)
    masked = (rng.random((3, 20)) < 0.3).astype(np.int32)
    past = [np.zeros((3, 6, 20), dtype=np.float32) for _ in range(2)]
    on_device = [wp.array(values, device="cpu") for values in past]
    slots = np.int32([4, -1, 0])
    inputs = [wp.array(values, device="cpu") for values in (slots, depth, nearest, masked)]
    wp.launch(store, (3, 20), [*inputs, *on_device], device="cpu")
    for env, slot in ((0, 4), (2, 0)):
        past[0][env, slot] = np.where(masked[env], -depth[env], depth[env])
        past[1][env, slot] = nearest[env]
    for expected, found in zip(past, on_device, strict=True):
        np.testing.assert_array_equal(found.numpy(), expected)
