"""Several surfel SLAMs in one batch do bit for bit what each does alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import arc
import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.shared.alignment_check import TrackingStatus
from ms_slam_env.slam.slam_backend import TrackResult
from ms_slam_env.slam.surfel import (
    BatchedSurfelSlam,
    SurfelConfig,
    photometry,
    preprocessing,
    rendering,
    surfels,
    tracker,
    view_prediction,
)
from ms_slam_env.slam.surfel.pose_hypotheses import motion_weight

CAMERA = xtion("80x60")
CONFIG = SurfelConfig(
    max_surfels=5000,  # so few that maps get crowded
    depth_cutoff_m=4.0,
    compaction_interval=3,
    unstable_window=4,
)
STEPS = 13
ENVS = 5
FUSED = (4, 9)  # steps at known poses; at the others frames are tracked
BLACK = {(1, 3), (1, 4), (1, 5), (3, 7), (4, 1)}  # (env, step) without a picture
RESET = {(2, 6), (4, 8)}
JUMP = (3, 8)  # env 3 is carried away; nothing there resembles what it has seen


def start_of(env: int) -> np.ndarray:
    eye = [-0.8 + 0.3 * env, -0.8, 1.2]
    return look_at(eye, [1.2 - 0.5 * env, 0.4, 0.6])


@pytest.fixture(scope="module")
def sequences(box_scene: BoxScene) -> list[list[tuple[RGBDFrame, np.ndarray]]]:
    """Frames and true poses of all envs, each with its own path and noise."""
    result = []
    for env in range(ENVS):
        sensor = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=env)
        pose, rng, frames = start_of(env), np.random.default_rng(env), []
        for step in range(STEPS):
            pose = pose @ make_pose(so3_exp(rng.normal(0, 0.008, 3)), rng.normal(0, 0.008, 3))
            if (env, step) == JUMP:
                pose = look_at([0.0, 0.0, 1.5], [-2.0, -2.0, 0.5])
            frame = sensor.capture(pose, step)
            if (env, step) in BLACK:
                frame = RGBDFrame(np.zeros_like(frame.color), np.zeros_like(frame.depth))
            frames.append((frame, pose))
        result.append(frames)
    return result


def on_device(images: np.ndarray) -> wp.array:
    dtype = wp.uint8 if images.dtype == np.uint8 else wp.float32
    return wp.array(images, dtype=dtype, device="cpu")


def run(
    sequences: list[list[tuple[RGBDFrame, np.ndarray]]],
    envs: list[int],
    given: Callable[[np.ndarray], Any] = np.asarray,
) -> dict[str, Any]:
    """Results of every step, and maps and views at the end, of some envs in one batch."""
    slam = BatchedSurfelSlam(len(envs), CAMERA, CONFIG)
    for row, env in enumerate(envs):
        slam.reset(sequences[env][0][1], row)
    results: list[list[TrackResult]] = []
    for step in range(STEPS):
        again = [row for row, env in enumerate(envs) if (env, step) in RESET]
        if again:
            starts = np.stack([sequences[envs[row]][step][1] for row in again])
            slam.reset_many(starts, np.array(again))
        color = given(np.stack([sequences[env][step][0].color for env in envs]))
        depth = given(np.stack([sequences[env][step][0].depth for env in envs]))
        poses = np.stack([sequences[env][step][1] for env in envs])
        if step in FUSED:
            results.append(slam.fuse(color, depth, poses))
            continue
        # Every other env has a good guess now and then; all at once have none in between.
        guesses = [
            pose if (env + step) % 2 == 0 and step % 3 == 0 else None
            for env, pose in zip(envs, poses, strict=True)
        ]
        results.append(slam.track(color, depth, guesses if step % 3 == 0 else None))
    motions = np.stack([make_pose(np.eye(3), [x, 0, 0]) for x in (-0.05, 0.05)])
    return {
        "results": results,
        "maps": slam.map.get_state()["surfels"],
        "counts": [slam.map.count(row) for row in range(len(envs))],
        "views": [
            slam.map.predict(slam.poses[row] @ motions, 0.5, row) for row in range(len(envs))
        ],
        "state": slam.get_state(),
    }


@pytest.fixture(scope="module")
def alone(sequences) -> list[dict[str, Any]]:
    return [run(sequences, [env]) for env in range(ENVS)]


@pytest.mark.parametrize(
    ("envs", "given"),
    [([0, 1], np.asarray), ([4, 2, 3, 1, 0], np.asarray), ([4, 2, 3, 1, 0], on_device)],
)
def test_a_batch_does_what_its_envs_do_alone(sequences, alone, envs, given):
    together = run(sequences, envs, given)
    for row, env in enumerate(envs):
        single = alone[env]
        for step in range(STEPS):
            expected = asdict(single["results"][step][0])
            found = asdict(together["results"][step][row])
            for name, value in expected.items():
                message = f"{name} of env {env} in step {step}"
                np.testing.assert_array_equal(found[name], value, err_msg=message)
        assert together["counts"][row] == single["counts"][0]
        for name, values in single["maps"][0].items():
            np.testing.assert_array_equal(together["maps"][row][name], values, err_msg=name)
        for name in ("intensity", "depth", "normals"):
            found = getattr(together["views"][row], name)
            np.testing.assert_array_equal(found, getattr(single["views"][0], name))
        for name in ("poses", "motions", "started", "lost", "time"):
            np.testing.assert_array_equal(
                together["state"][name][row], single["state"][name][0], err_msg=name
            )


def test_the_ways_of_a_gpu_lead_to_the_same_poses(sequences, alone, monkeypatch):
    """Many threads an env, a pixel each, a launch a step: all of it but that they run in turns."""

    def pixel_by_pixel(width: int, device: str, gpu_columns: int = 1) -> tuple[int, int]:
        return gpu_columns, -(-width // gpu_columns)

    for module in (photometry, preprocessing, rendering, tracker, view_prediction):
        monkeypatch.setattr(module, "threads_per_row", pixel_by_pixel)
    monkeypatch.setattr(surfels, "default_workers", lambda batch, device: 70)
    never = property(lambda _: False, lambda *_: None)
    monkeypatch.setattr(tracker.GaussNewton, "at_once", never, raising=False)
    together = run(sequences, list(range(ENVS)), on_device)
    assert together["counts"] != [single["counts"][0] for single in alone]  # sums in another order
    for env in range(ENVS):
        for step in range(STEPS):
            expected, found = alone[env]["results"][step][0], together["results"][step][env]
            assert found.tracking_ok == expected.tracking_ok
            difference = np.abs(found.T_world_camera - expected.T_world_camera).max()
            is_jumping = env == JUMP[0] and step >= JUMP[1]  # found in what little it has seen
            assert difference < (2e-2 if is_jumping else 2e-3), (env, step)


def test_several_envs_are_reset_at_once_and_others_left_alone(sequences):
    pair = [BatchedSurfelSlam(3, CAMERA, CONFIG) for _ in range(2)]
    poses = np.stack([start_of(env) for env in range(3)])
    frames = [sequences[env][0][0] for env in range(3)]
    color, depth = (np.stack([getattr(f, name) for f in frames]) for name in ("color", "depth"))
    for each in pair:
        each.reset_many(poses, np.arange(3))
        for _ in range(2):
            each.track(color, depth)
    pair[0].reset_many(poses[[2, 0]], np.array([0, 2]))
    pair[1].reset(poses[2], 0)
    pair[1].reset(poses[0], 2)
    assert [pair[0].map.count(env) > 0 for env in range(3)] == [False, True, False]
    np.testing.assert_array_equal(pair[0].poses[[0, 2]], poses[[2, 0]])
    for one, other in zip(*(each.track(color, depth) for each in pair), strict=True):
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
        assert one.tracking_ok
    counts = [[each.map.count(env) for env in range(3)] for each in pair]
    assert counts[0] == counts[1]
    with pytest.raises(InputError, match="must have shape"):
        pair[0].reset_many(poses, np.array([1]))


def test_arrays_hold_what_results_say(sequences):
    """And they are the caller's own: later frames leave them as they are."""
    pair = [BatchedSurfelSlam(2, CAMERA, CONFIG) for _ in range(2)]
    arrays, results = [], []
    for step in range(6):
        frames = [sequences[env][step][0] for env in (0, 1)]  # env 1 is black from step 3 on
        color, depth = (np.stack([getattr(f, name) for f in frames]) for name in ("color", "depth"))
        arrays.append(pair[0].track_arrays(color, depth))
        results.append(pair[1].track(color, depth))
    for found, row in zip(arrays, results, strict=True):
        names = ("T_world_camera", "tracking_ok", "uncertain", "relocalised", "inlier_fraction")
        for name in (*names, "residual_m", "overlap", "degenerate_directions", "fused"):
            expected = [getattr(result, name) for result in row]
            np.testing.assert_array_equal(getattr(found, name), expected, err_msg=name)
        for env, result in enumerate(row):
            is_known = result.covariance is not None
            assert np.isfinite(found.covariance[env]).all() == is_known
            if is_known:
                np.testing.assert_array_equal(found.covariance[env], result.covariance)
    assert arrays[0].is_first.all()
    assert not arrays[1].is_first.any()
    assert arrays[4].status.tolist() == [TrackingStatus.OK, TrackingStatus.BLANK]


def test_the_envs_differ_in_what_they_do(alone):
    """Otherwise the comparison would say little."""
    ok = np.array([[step[0].tracking_ok for step in single["results"]] for single in alone])
    assert ok[0].all()
    assert not ok[1, 3]
    assert not ok[3, 7:9].any()
    assert (ok.mean(axis=1) > 0.5).all()
    assert len({tuple(row) for row in ok}) >= 4
    counts = [single["counts"][0] for single in alone]
    assert np.median(counts) > 4000


def test_motion_weight_falls_from_one_to_a_half():
    motions = np.stack(
        [np.eye(4), make_pose(np.eye(3), [0.05, 0, 0]), make_pose(so3_exp([0, 0.5, 0]), [0, 0, 0])]
    )
    np.testing.assert_allclose(motion_weight(motions), [1.0, 0.75, 0.5])


def test_bad_input_is_refused(arc_frames):
    batched = BatchedSurfelSlam(1, arc.CAMERA, SurfelConfig(max_surfels=60_000))
    color, depth = arc_frames[0].color[None], arc_frames[0].depth[None]
    for bad in (np.nan, np.inf, -1.0):
        with pytest.raises(InputError, match="depth holds"):
            batched.track(color, np.where(depth == depth.max(), np.float32(bad), depth))
    for images in ((color[:, 1:], depth[:, 1:]), (color, depth[:, 1:]), (color[0], depth[0])):
        with pytest.raises(InputError, match=r"must be \(1, 120, 160, 3\)"):
            batched.track(*images)
    for bad in (np.nan, np.inf, -1.0):
        there = on_device(color), on_device(np.where(depth == depth.max(), np.float32(bad), depth))
        with pytest.raises(InputError, match="depth holds"):
            batched.track(*there)
    for images in ((on_device(color), depth), (color, on_device(depth))):
        with pytest.raises(InputError, match="must both be"):
            batched.track(*images)
    with pytest.raises(InputError, match="must be NumPy arrays"):
        batched.track(color.tolist(), depth.tolist())
    with pytest.raises(InputError, match="float32, not uint8"):
        batched.track(on_device(depth), on_device(depth))
    with pytest.raises(InputError, match="surfel"):
        slam.make("orb", CAMERA)
    with pytest.raises(InputError, match="iterations"):
        slam.make("surfel", CAMERA, iterations=(1, -1))


@pytest.mark.parametrize(("columns", "capacity"), [(80, 500_000), (160, 500_000), (320, 1_000_000)])
def test_room_in_the_map_grows_with_the_image(columns: int, capacity: int) -> None:
    assert SurfelConfig().capacity(columns) == capacity
    assert SurfelConfig(max_surfels=5000).capacity(columns) == 5000
