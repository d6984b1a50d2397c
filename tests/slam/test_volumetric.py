"""The voxel grid against closed-form views, and Open3D being absent."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from surfel_scenes import WALL_NORMAL, WALL_POINT, ray_cast

from ms_slam_env import slam
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose, so3_exp

# No multiple of 8: Open3D's default bounds of rays would be read out of range.
CAMERA = Intrinsics(fx=150.0, fy=155.0, cx=74.3, cy=56.8, width=150, height=114)
VOXEL_M = 0.02
POSE = make_pose(so3_exp([0.05, -0.1, 0.2]), [0.1, 0.05, -0.1])


@pytest.fixture(autouse=True)
def _open3d():
    pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)


def _frame(pose: np.ndarray) -> RGBDFrame:
    depth, _, color = ray_cast(pose, CAMERA, box=False)
    return RGBDFrame(np.rint(color).astype(np.uint8), depth.astype(np.float32))


def _mapped(count: int, **options: object) -> slam.SlamBackend:
    backend = slam.make("volumetric", CAMERA, **{"voxel_m": VOXEL_M, **options})
    for _ in range(count):
        backend.fuse(_frame(POSE), POSE)
    return backend


def test_one_frame_is_cast_whole_and_unbiased():
    views = _mapped(1).predict(POSE[None])
    depth, normals, color = ray_cast(POSE, CAMERA, box=False)
    inner = np.zeros(CAMERA.shape, dtype=bool)
    inner[4:-4, 4:-4] = True
    hit = views.depth[0] > 0
    assert hit[inner].mean() > 0.99
    both = inner & hit
    error = (views.depth[0] - depth)[both]
    assert abs(np.median(error)) < 0.1 * VOXEL_M  # Open3D's own is half a voxel off
    assert np.percentile(np.abs(error), 90) < 0.5 * VOXEL_M
    grey = color @ [0.299, 0.587, 0.114]
    assert np.median(np.abs(views.intensity[0] - grey)[both]) < 2
    cosine = (views.normals[0] * normals).sum(-1)[both]
    assert np.median(cosine) > 0.99


def test_the_first_cast_sees_every_block():
    # Open3D's own first cast leaves out all pieces of blocks beyond about a hundred.
    camera = xtion("160x120")
    depth, _, color = ray_cast(POSE, camera)
    backend = slam.make("volumetric", camera)
    backend.fuse(RGBDFrame(np.rint(color).astype(np.uint8), depth.astype(np.float32)), POSE)
    first, second = (backend.predict(POSE[None]).depth[0] for _ in range(2))
    assert (first[4:-4, 4:-4] > 0).mean() > 0.95
    np.testing.assert_array_equal(first, second)


def test_colors_stay_at_their_pixels():
    # Edges between black and white; half a pixel too far right or down would add half a pixel.
    column, row = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    white = (column >= 70) ^ (row >= 60)
    color = np.repeat(np.where(white, 255, 0)[..., None], 3, axis=2).astype(np.uint8)
    depth = np.full(CAMERA.shape, 1.5, dtype=np.float32)
    backend = slam.make("volumetric", CAMERA, voxel_m=0.007)
    backend.fuse(RGBDFrame(color, depth), np.eye(4))
    grey = backend.predict(np.eye(4)[None]).intensity[0] / 255
    assert (1 - grey[20:40, 50:90]).sum(axis=1).mean() == pytest.approx(20, abs=0.25)
    assert (1 - grey[40:80, 20:50]).sum(axis=0).mean() == pytest.approx(20, abs=0.25)


def test_surface_points_lie_on_the_wall():
    backend = _mapped(2)
    points = backend.surface_points()
    assert len(points) > 1000
    assert np.median(np.abs((points - WALL_POINT) @ WALL_NORMAL)) < 0.15 * VOXEL_M
    normals = backend.map_attributes()["normal"]
    assert np.median(np.abs(normals @ WALL_NORMAL)) > 0.99
    np.testing.assert_array_equal(points, _mapped(2).surface_points())


def test_voxels_seen_less_often_than_asked_are_no_surface():
    assert not _mapped(2, least_weight=3).predict(POSE[None]).depth.any()
    assert len(_mapped(2, least_weight=3).surface_points()) == 0
    assert _mapped(3, least_weight=3).predict(POSE[None]).depth.any()


def test_the_grid_grows_when_its_blocks_are_used_up():
    small, large = _mapped(1, blocks=100), _mapped(1, blocks=4000)
    np.testing.assert_array_equal(small.surface_points(), large.surface_points())
    np.testing.assert_array_equal(small.predict(POSE[None]).depth, large.predict(POSE[None]).depth)


def test_frames_without_a_reading_within_reach_are_taken():
    """Open3D gives up on them."""
    backend = slam.make("volumetric", CAMERA, voxel_m=VOXEL_M)
    shape = (CAMERA.height, CAMERA.width)
    color = np.full((*shape, 3), 99, np.uint8)
    for metres in (0.0, 1e-6, 12.0, 1e4):
        backend.reset(POSE)
        result = backend.track(RGBDFrame(color, np.full(shape, metres, np.float32)))
        assert np.isfinite(result.T_world_camera).all()
        assert len(backend.surface_points()) == 0


def test_open3d_can_align_too():
    backend = _mapped(3, aligner="open3d")
    moved = POSE @ make_pose(so3_exp([0.0, 0.005, 0.0]), [0.005, 0.0, 0.005])
    result = backend.track(_frame(moved))
    assert result.tracking_ok, result.reason
    # A plane leaves three directions to the smooth texture alone.
    assert abs((result.T_world_camera - moved)[:3, 3] @ WALL_NORMAL) < 0.005
    with pytest.raises(InputError, match="valid choices: opencv, open3d"):
        slam.make("volumetric", CAMERA, aligner="icp")


def test_without_open3d_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match=r"ms-slam-env\[open3d\].*libgl1"):
        slam.make("volumetric", xtion("80x60"))


def test_the_peer_aligns_by_geometry_alone_and_checks_nothing(box_scene):
    """An image with negated brightness has the same depth."""
    from ms_slam_env.sensor import RGBDSensor

    camera = xtion("160x120")
    sensor = RGBDSensor(box_scene, camera, noise="none", seed=0)
    start = look_at([-0.8, -0.8, 1.2], [1.0, 0.0, 0.6])
    moved = start @ make_pose(so3_exp([0.0, 0.01, 0.0]), [0.01, -0.005, 0.01])
    frame = sensor.capture(moved, 1)
    negative = RGBDFrame(255 - frame.color, frame.depth)
    results = {}
    for name in ("volumetric", "open3d"):
        backend = slam.make(name, camera)
        backend.reset(start)
        black = np.zeros((*camera.shape, 3), dtype=np.uint8), np.zeros(camera.shape, np.float32)
        assert not backend.track(RGBDFrame(*black)).tracking_ok
        backend.track(sensor.capture(start, 0))
        results[name] = backend.track(negative)
    assert not results["volumetric"].tracking_ok
    assert results["open3d"].tracking_ok
    error = results["open3d"].T_world_camera[:3, 3] - moved[:3, 3]
    assert np.linalg.norm(error) < 0.004


def test_truncation_may_be_a_whole_number():
    one, other = (_mapped(1, truncation_voxels=value).predict(POSE[None]) for value in (8, 8.0))
    np.testing.assert_array_equal(one.depth, other.depth)
