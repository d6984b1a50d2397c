"""KinectFusion: its alignment against a slow one, and what each of its parameters does."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)

from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import xtion
from ms_slam_env.geometry import invert, look_at, make_pose, se3_exp, so3_exp, transform_points
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.slam.volumetric import KinectFusionConfig
from ms_slam_env.slam.volumetric.projective_icp import ProjectiveICP, frame_pyramid, model_surface
from ms_slam_env.slam.volumetric.voxel_grid import CastView
from ms_slam_env.tuning import make_space

CAMERA = xtion("160x120")
CORNER = look_at([-0.4, -0.7, 1.4], [1.6, 0.6, 0.4])
STEP = make_pose(so3_exp(np.radians([1.0, -2.0, 0.5])), [0.03, -0.01, 0.02])


@pytest.fixture(scope="module")
def sensor(box_scene: BoxScene) -> RGBDSensor:
    return RGBDSensor(box_scene, CAMERA, noise="none")


def view_of(sensor, pose):
    truth = sensor.ground_truth(pose)
    return CastView(truth.depth, truth.color.astype(np.float32) / 255, truth.normals)


def aligned(sensor, iterations=(10, 5, 4), threshold=1e-5):
    icp = ProjectiveICP(CAMERA, iterations, threshold, 0.1, 0.8)
    frame = frame_pyramid(sensor.capture(CORNER @ STEP, 0).depth, CAMERA, len(iterations))
    return icp, frame, model_surface(view_of(sensor, CORNER), CAMERA)


def test_a_known_motion_is_found(sensor):
    icp, frame, model = aligned(sensor)
    T, sums = icp.align(frame, model)
    assert np.linalg.norm((invert(STEP) @ T)[:3, 3]) < 0.002
    assert np.abs(T[:3, :3] - STEP[:3, :3]).max() < 0.001
    assert sums.residual_m < 0.005
    assert sums.inliers > 0.5 * 160 * 120


def test_sums_are_those_of_the_slow_way(sensor):
    icp, frame, model = aligned(sensor)
    T = se3_exp([0.01, 0.0, -0.01, 0.004, 0.002, 0.0])
    points, normals = (a.numpy().reshape(-1, 3).astype(float) for a in vars(frame[1]).values())
    targets, facing = (a.numpy().astype(float) for a in vars(model).values())
    H, g, inliers, squares = np.zeros((6, 6)), np.zeros(6), 0, 0.0
    for v, n in zip(points, normals, strict=True):
        if np.linalg.norm(n) < 0.5:
            continue
        p = transform_points(T, v)
        column, row = np.floor(CAMERA.project(p) + 0.5).astype(int)
        if not (0 <= column < CAMERA.width and 0 <= row < CAMERA.height):
            continue
        m, f = targets[row, column], facing[row, column]
        if np.linalg.norm(m - p) < 0.1 and f @ T[:3, :3] @ n > 0.8:
            J = np.concatenate([f, np.cross(p, f)])
            H += np.outer(J, J)
            g += J * (f @ (m - p))
            inliers += 1
            squares += (f @ (m - p)) ** 2
    sums = icp.accumulate(frame[1], model, T)
    assert abs(sums.inliers - inliers) <= 3  # some lie on a border
    np.testing.assert_allclose(sums.H, H, rtol=0.01, atol=0.01 * np.abs(H).max())
    np.testing.assert_allclose(sums.g, g, atol=0.02 * np.abs(g).max())
    assert sums.residual_m == pytest.approx(np.sqrt(squares / inliers), rel=0.02)


def test_a_level_ends_below_the_threshold(sensor, monkeypatch):
    def passes(threshold):
        icp, frame, model = aligned(sensor, threshold=threshold)
        seen = []
        counted = icp.accumulate
        monkeypatch.setattr(icp, "accumulate", lambda *a: (seen.append(1), counted(*a))[1])
        icp.align(frame, model)
        return len(seen)

    assert passes(100.0) == 4  # one a level, and the last look
    assert passes(1e-5) > 6
    assert passes(0.0) == 10 + 5 + 4 + 1


def test_without_iterations_the_pose_stays_at_rest(sensor):
    icp, frame, model = aligned(sensor, iterations=(0, 0))
    T, _ = icp.align(frame, model)
    np.testing.assert_array_equal(T, np.eye(4))


def test_nothing_to_align_with_is_no_pose(sensor):
    icp, frame, _ = aligned(sensor)
    empty = view_of(sensor, CORNER)
    empty = CastView(0 * empty.depth, empty.color, 0 * empty.normals)
    assert icp.align(frame, model_surface(empty, CAMERA))[0] is None


def test_a_flat_wall_leaves_the_pose_open():
    z = np.full(CAMERA.shape, 2.0, np.float32)
    normals = np.zeros((*CAMERA.shape, 3), np.float32) - (0, 0, 1)
    wall = CastView(z, np.zeros_like(normals, np.float32), normals.astype(np.float32))
    icp = ProjectiveICP(CAMERA, (10, 5, 4), 1e-5, 0.1, 0.8)
    assert icp.align(frame_pyramid(z, CAMERA, 3), model_surface(wall, CAMERA))[0] is None


def mapped(sensor, **options):
    backend = slam.make("kinectfusion", CAMERA, **options)
    backend.reset(CORNER)
    for k in range(6):
        T = CORNER @ make_pose(np.eye(3), [0.01 * k, 0.0, 0.0])
        result = backend.track(sensor.capture(T, k))
        assert result.tracking_ok, result.reason
    return backend


def test_only_the_volume_is_mapped(sensor):
    whole = mapped(sensor).surface_points()
    part = mapped(sensor, volume_size_m=2.4, volume_resolution=150, start_z=0.0)
    seen = transform_points(invert(CORNER), part.surface_points())
    assert len(seen) > 500
    border = 2.4 / 150
    assert np.abs(seen[:, :2]).max() < 1.2 + 2 * border
    assert seen[:, 2].max() < 2.4 + 2 * border
    everything = transform_points(invert(CORNER), whole)
    assert everything[:, 2].max() > 2.6


def test_resolution_and_mu_make_the_voxels():
    grid = KinectFusionConfig(volume_size_m=5.0, volume_resolution=250, mu_m=0.07).grid
    assert grid.voxel_m == pytest.approx(0.02)
    assert grid.truncation_voxels == pytest.approx(3.5)
    for size, resolution, mu in ((1.0, 1024, 0.5), (20.0, 64, 0.001)):  # whatever is drawn
        KinectFusionConfig(volume_size_m=size, volume_resolution=resolution, mu_m=mu).grid  # noqa: B018


def test_some_frames_are_not_fused(sensor):
    every, third = mapped(sensor), mapped(sensor, integration_rate=5)
    weights = [b.get_state()["grid"]["weight"].max() for b in (every, third)]
    assert weights == [6, 5]  # the first, three more, and the fifth that was tracked


def test_stock_asks_for_nothing_but_slambenchs_rules(sensor):
    dark = replace(sensor.capture(CORNER, 9), color=np.zeros((*CAMERA.shape, 3), np.uint8))
    guarded = mapped(sensor).track(dark)
    assert guarded.reason == "the frame's intensity does not fit the view that it is aligned with"
    assert mapped(sensor, stock=True).track(dark).tracking_ok
    strict = slam.make("kinectfusion", CAMERA, stock=True, track_residual_m=0.001)
    noisy = RGBDSensor(sensor.scene, CAMERA, noise="kinect")
    assert strict.track(noisy.capture(CORNER, 0)).tracking_ok  # the first makes the map
    assert not strict.track(noisy.capture(CORNER, 1)).tracking_ok


def test_its_parameters_can_be_explored():
    space = make_space(("kinectfusion",), SlamConfiguration("kinectfusion"))
    names = {"volume_resolution", "mu_m", "icp_threshold", "iterations.0", "integration_rate"}
    assert names <= set(space.parameters)
    values = {"iterations.2": 0, "volume_resolution": 64, "mu_m": 0.5, "volume_size_m": 12.0}
    config = space.configuration(values).slam_config
    assert config["iterations"] == [10, 5, 0]
    slam.make("kinectfusion", CAMERA, **config)
