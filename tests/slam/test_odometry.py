"""Odometry and dense SLAM as they are (``stock``), long losses, semi-dense alignment."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BoxScene
from hypothesis import given, settings
from hypothesis import strategies as st
from surfel_scenes import ray_cast

from ms_slam_env import slam
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, look_at, make_pose, se3_exp, so3_exp
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences import Sequence, handheld_trajectory, render_sequence
from ms_slam_env.slam.odometry import odometry
from ms_slam_env.slam.odometry.semi_dense import SemiDenseAligner, normal_equations
from ms_slam_env.slam.shared.alignment_measures import DepthImage
from ms_slam_env.slam.shared.tracking_template import SEARCHED_FRAMES

CAMERA = xtion("160x120")
BLACK = RGBDFrame(
    np.zeros((*CAMERA.shape, 3), dtype=np.uint8), np.zeros(CAMERA.shape, dtype=np.float32)
)


@pytest.fixture(scope="module")
def sequence(box_scene: BoxScene) -> Sequence:
    poses = handheld_trajectory(box_scene, 12, seed=0)
    return render_sequence(box_scene, poses, CAMERA, noise="none")


def _make(name: str, sequence: Sequence) -> slam.SlamBackend:
    if name == "volumetric":
        pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)
    backend = slam.make(name, CAMERA, stock=True)
    backend.reset(sequence.poses[0])
    return backend


@pytest.mark.parametrize(("name", "limit_m"), [("odometry", 0.005), ("volumetric", 0.03)])
def test_a_clean_sequence_is_tracked(name: str, limit_m: float, sequence: Sequence) -> None:
    backend = _make(name, sequence)
    results = [backend.track(frame) for frame in sequence.frames]
    assert all(result.tracking_ok for result in results)
    estimates = [result.T_world_camera for result in results]
    assert ate_rmse(estimates, sequence.poses, align="none") < limit_m
    assert len(backend.surface_points()) > 1000


def test_stock_is_what_open3d_does(sequence: Sequence) -> None:
    """Its ``t.pipelines.slam.Model``, driven as in its example ``dense_slam.py``."""
    backend = _make("volumetric", sequence)
    backend.reset()  # the voxels lie as in its model
    found = [backend.track(frame).T_world_camera for frame in sequence.frames]
    import open3d as o3d

    device, scale, cutoff_m = o3d.core.Device("CPU:0"), 5000.0, 4.0
    pose = o3d.core.Tensor(np.eye(4))
    model = o3d.t.pipelines.slam.Model(0.01, 16, 40_000, pose, device)
    K = o3d.core.Tensor(CAMERA.matrix)
    live, view = (o3d.t.pipelines.slam.Frame(*CAMERA.shape, K, device) for _ in range(2))
    for index, frame in enumerate(sequence.frames):
        depth = np.rint(frame.depth * scale).astype(np.uint16)[..., None]
        for name, image in (("depth", depth), ("color", np.ascontiguousarray(frame.color))):
            live.set_data_from_image(name, o3d.t.geometry.Image(o3d.core.Tensor(image)))
        if index:
            result = model.track_frame_to_model(live, view, scale, cutoff_m, 0.07)
            pose = pose @ result.transformation
        model.update_frame_pose(index, pose)
        model.integrate(live, scale, cutoff_m, 8.0)
        model.synthesize_model_frame(view, scale, 0.1, cutoff_m, 8.0, False)
        np.testing.assert_allclose(found[index], pose.numpy(), atol=5e-3)


def test_any_motion_that_is_found_is_believed(sequence: Sequence) -> None:
    """A frame upside down in brightness fits nothing, and only the checks can tell."""
    frame = sequence.frames[1]
    negative = RGBDFrame(255 - frame.color, frame.depth)
    results = {}
    for stock in (False, True):
        backend = slam.make("odometry", CAMERA, stock=stock)
        backend.reset(sequence.poses[0])
        backend.track(sequence.frames[0])
        results[stock] = backend.track(negative)
    assert "intensity" in results[False].reason
    assert results[True].tracking_ok


def test_a_frame_that_cannot_be_aligned_becomes_the_keyframe(sequence: Sequence) -> None:
    backend = _make("odometry", sequence)
    held = backend.track(sequence.frames[0]).T_world_camera
    for frame in (BLACK, sequence.frames[4]):  # nothing aligns with a black keyframe
        result = backend.track(frame)
        assert not result.tracking_ok
        np.testing.assert_array_equal(result.T_world_camera, held)
    assert backend.track(sequence.frames[5]).relocalised


SMALL = Intrinsics(fx=60.0, fy=60.0, cx=39.5, cy=29.5, width=80, height=60)


def _frame(pose: np.ndarray) -> RGBDFrame:
    depth, _, color = ray_cast(pose, SMALL)
    return RGBDFrame(np.rint(color).astype(np.uint8), depth.astype(np.float32))


def test_a_camera_that_is_lost_for_long_is_sought_in_every_tenth_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched: list[int] = []
    lost: list[bool] = []
    search = odometry.motion_hypotheses

    def counted(*args: object) -> object:
        searched.append(len(lost))
        return search(*args)

    monkeypatch.setattr(odometry, "motion_hypotheses", counted)
    backend = slam.make("odometry", SMALL)
    home = _frame(np.eye(4))
    assert backend.track(home).tracking_ok
    noise = np.random.default_rng(0)
    elsewhere = RGBDFrame(
        noise.integers(0, 255, (60, 80, 3), dtype=np.uint8),
        noise.uniform(0.5, 3.5, (60, 80)).astype(np.float32),
    )
    for _ in range(SEARCHED_FRAMES + 25):
        lost.append(not backend.track(elsewhere).tracking_ok)
    assert all(lost)
    assert searched == [*range(SEARCHED_FRAMES + 1), SEARCHED_FRAMES + 10, SEARCHED_FRAMES + 20]
    moved = make_pose(so3_exp([0.0, np.radians(9.0), 0.0]), [0.08, 0.0, 0.0])
    found = [backend.track(_frame(moved)) for _ in range(10)]
    assert any(result.relocalised for result in found)
    searched.clear()
    backend.track(elsewhere)
    assert len(searched) == 1  # the count begins anew


POSE = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])


def image(scene, pose, noise="none"):
    frame = RGBDSensor(scene, CAMERA, noise=noise).capture(pose, 0)
    return DepthImage(frame.depth, intensity_image(frame.color).astype(np.float32))


@pytest.fixture(scope="module")
def aligner():
    return SemiDenseAligner(CAMERA)


@pytest.fixture(scope="module")
def reference(box_scene: BoxScene, aligner):
    return aligner.prepare(image(box_scene, POSE))


def test_points_are_where_the_image_has_gradients_and_depth_has_none(reference):
    level = reference[0]
    assert 500 < len(level.points) < 0.7 * 160 * 120
    column, row = np.rint(CAMERA.project(level.points)).astype(int).T
    assert np.hypot(level.image[row, column, 1], level.image[row, column, 2]).min() > 5
    np.testing.assert_array_equal(level.image[row, column, 0], level.grey)
    slope = np.gradient(level.image[..., 0], axis=1)[1:-1, 1:-1]  # one more way to the same
    np.testing.assert_allclose(level.image[1:-1, 1:-1, 1], slope, atol=1e-4)


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(-0.01, 0.01), min_size=6, max_size=6))
def test_the_gradient_is_that_of_the_cost(box_scene, aligner, reference, xi):
    """Up to the gradients of the image, which are differences and not slopes of its pieces."""
    moved = POSE @ make_pose(so3_exp([0.0, 0.02, 0.0]), [0.02, 0.0, 0.0])
    frame = aligner.prepare(image(box_scene, moved))
    T = se3_exp(np.array(xi))
    H, g, cost = normal_equations(frame[0], reference[0], T)
    step = np.linalg.solve(H, g)
    length = 0.3 * step / max(1.0, np.linalg.norm(step) / 0.004)
    lower = normal_equations(frame[0], reference[0], se3_exp(length) @ T)[2]
    higher = normal_equations(frame[0], reference[0], se3_exp(-length) @ T)[2]
    assert lower < cost < higher
    np.testing.assert_allclose(H, H.T, rtol=1e-9)
    assert np.linalg.eigvalsh(H)[0] > 0


@pytest.mark.parametrize("noise", ["none", "kinect"])
def test_a_known_motion_is_found(box_scene, aligner, noise):
    motion = make_pose(so3_exp(np.radians([1.0, 2.5, -0.5])), [0.03, 0.01, 0.02])
    pair = [aligner.prepare(image(box_scene, T, noise)) for T in (POSE @ motion, POSE)]
    error = invert(motion) @ aligner.align(*pair)
    assert np.linalg.norm(error[:3, 3]) < 0.006
    assert np.abs(error[:3, :3] - np.eye(3)).max() < 0.003
    rest = aligner.align(pair[1], pair[1])
    np.testing.assert_allclose(rest, np.eye(4), atol=1e-9)


def test_a_blank_image_has_no_pose(aligner, reference):
    blank = DepthImage(np.full(CAMERA.shape, 2.0, np.float32), np.zeros(CAMERA.shape, np.float32))
    assert aligner.align(aligner.prepare(blank), aligner.prepare(blank)) is None


@pytest.mark.parametrize("size", ["80x60", "160x120"])
def test_as_a_backend_it_tracks(box_scene, size):
    K = xtion(size)
    sensor = RGBDSensor(box_scene, K, noise="kinect")
    backend = slam.make("odometry", K, aligner="semi-dense", max_surfels=60_000)
    backend.reset(POSE)
    step = make_pose(so3_exp([0, np.radians(-0.5), 0]), [0.01, 0, 0.002])
    pose = POSE
    for index in range(10):
        result = backend.track(sensor.capture(pose, index))
        assert result.tracking_ok, result.reason
        assert np.linalg.norm(result.T_world_camera[:3, 3] - pose[:3, 3]) < 0.015
        pose = pose @ step
    with pytest.raises(InputError, match="valid choices: opencv, semi-dense"):
        slam.make("odometry", K, aligner="lsd")
