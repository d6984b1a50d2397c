"""Predicted views against closed forms and direct splatting."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter
from surfel_scenes import SMALL, build_map, device_poses, ray_cast

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.robot.action_primitives import decompose
from ms_slam_env.slam.surfel import view_prediction
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.surfels import SplatCamera
from ms_slam_env.slam.surfel.view_prediction import (
    EMPTY,
    PointCloud,
    mean_pose,
    scatter_points,
    wide_intrinsics,
)

LUMA = np.array([0.299, 0.587, 0.114])
WIDE_PATH = np.stack(
    [
        make_pose(so3_exp([x, y, 0.0]), [0.1 * y, -0.1 * x, 0.0])
        for x in (-0.2, 0.0, 0.2)
        for y in (-0.25, 0.0, 0.25)
    ]
)
CANDIDATES = decompose(0.05, np.radians(5.0))


@pytest.fixture(scope="module")
def wide_map() -> SurfelMap:
    """A clean map that reaches beyond the view of the identity pose on all sides."""
    return build_map(WIDE_PATH)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_the_49_views_are_the_scene(wide_map: SurfelMap, scale: float) -> None:
    views = wide_map.predict(CANDIDATES, scale)
    camera = SMALL.scaled(scale)
    assert views.intrinsics == camera
    assert views.depth.shape == (49, *camera.shape)
    for pose, depth, normals, intensity in zip(
        CANDIDATES, views.depth, views.normals, views.intensity, strict=True
    ):
        true_depth, true_normals, color = ray_cast(pose, camera)
        assert (depth > 0).mean() > 0.97
        same_surface = np.abs(depth - true_depth) < 0.02
        assert same_surface.mean() > 0.9  # but the rim of the box
        assert np.median(np.abs(depth - true_depth)[same_surface]) < 2e-4
        np.testing.assert_allclose(
            np.median(normals[same_surface & (true_depth > 1.5)], axis=0),
            np.median(true_normals[true_depth > 1.5], axis=0),
            atol=1e-3,
        )
        # Each pixel shows a point within a pixel of it.
        grey = color @ LUMA
        within = (intensity > minimum_filter(grey, 3) - 3) & (
            intensity < maximum_filter(grey, 3) + 3
        )
        assert within[same_surface].mean() > 0.97


def test_warped_views_agree_with_direct_splatting(wide_map: SurfelMap) -> None:
    views = wide_map.predict(CANDIDATES)
    for pose, depth, intensity in zip(CANDIDATES, views.depth, views.intensity, strict=True):
        direct = wide_map.render_model(device_poses(pose[None]))
        direct_depth = direct.vertices.numpy()[0, ..., 2]
        agree = (np.abs(depth - direct_depth) < 0.01) & (depth > 0)
        assert agree.mean() > 0.93
        difference = intensity - direct.intensity.numpy()[0]
        assert np.abs(difference)[agree].mean() < 5.0
        assert abs(difference[agree].mean()) < 1.0  # all pixels may be off by the same half pixel


def test_surface_hidden_from_the_reference_is_predicted() -> None:
    surfel_map = build_map(WIDE_PATH)
    aside = make_pose(np.eye(3), [0.12, 0.0, 0.0])  # looks past the box at what it hid
    poses = np.stack([np.eye(4), aside, make_pose(np.eye(3), [-0.12, 0.0, 0.0])])
    views = surfel_map.predict(poses)
    true_depth = ray_cast(aside, SMALL)[0]
    error = np.abs(views.depth[1] - true_depth)
    assert (error < 0.02).mean() > 0.95


def test_views_far_apart_are_splatted_one_by_one(wide_map: SurfelMap) -> None:
    turned = make_pose(so3_exp([0.0, 2.5, 0.0]), [0.0, 0.0, 0.0])
    poses = np.stack([np.eye(4), turned, np.eye(4)])
    views = wide_map.predict(poses)
    direct = wide_map.render_model(device_poses(np.eye(4)[None]))
    np.testing.assert_array_equal(views.depth[0], direct.vertices.numpy()[0, ..., 2])
    np.testing.assert_array_equal(views.intensity[0], direct.intensity.numpy()[0])
    np.testing.assert_array_equal(views.depth[0], views.depth[2])
    assert (views.depth[1] == 0).all()


def test_of_dozens_of_surfels_to_a_pixel_some_are_enough(
    wide_map: SurfelMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    turned = make_pose(so3_exp([0.0, 2.5, 0.0]), [0.0, 0.0, 0.0])
    poses = np.stack([np.eye(4), turned])
    enough = wide_map.predict(poses, 0.25)
    monkeypatch.setattr(view_prediction, "LAYERS", np.inf)
    every = wide_map.predict(poses, 0.25)
    assert not np.array_equal(enough.intensity, every.intensity)
    assert ((enough.depth > 0) == (every.depth > 0)).mean() > 0.995
    assert np.percentile(np.abs(enough.depth - every.depth), 95) < 0.005
    monkeypatch.setattr(view_prediction, "LAYERS", 0.01)
    assert (wide_map.predict(poses, 0.25).depth[0] > 0).mean() < 0.5


def test_prediction_repeats_bit_exactly_and_leaves_the_map_alone(wide_map: SurfelMap) -> None:
    before = wide_map.get_state()["surfels"][0]
    first, second = wide_map.predict(CANDIDATES, 0.5), wide_map.predict(CANDIDATES, 0.5)
    np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(first.intensity, second.intensity)
    for name, values in wide_map.get_state()["surfels"][0].items():
        np.testing.assert_array_equal(values, before[name])


def test_the_reference_view_contains_all_views() -> None:
    wide = wide_intrinsics(SMALL, CANDIDATES)
    assert wide is not None
    rng = np.random.default_rng(0)
    corners = np.array([[u, v] for u in (-0.5, 39.5) for v in (-0.5, 29.5)])
    rays = np.stack([(corners[:, 0] - 19.3) / 40.0, (corners[:, 1] - 14.8) / 42.0, np.ones(4)], 1)
    for motion in CANDIDATES:
        points = rays * rng.uniform(0.6, 4.0, (4, 1)) @ motion[:3, :3].T + motion[:3, 3]
        pixels = wide.project(points)
        assert (pixels >= -0.5).all()
        assert (pixels <= [wide.width - 0.5, wide.height - 0.5]).all()


def test_the_mean_of_symmetric_motions_is_the_middle() -> None:
    middle = make_pose(so3_exp([0.3, -0.4, 0.9]), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(mean_pose(middle @ CANDIDATES), middle, atol=1e-9)


@pytest.mark.parametrize(
    ("poses", "scale"),
    [
        (np.zeros((1, 0, 4, 4)), 1.0),
        (np.eye(4), 1.0),
        (np.full((1, 2, 4, 4), np.nan), 1.0),
        (np.eye(4)[None, None], 0.0),
        (np.eye(4)[None, None], float("nan")),
    ],
)
def test_bad_poses_and_scales_are_refused(
    wide_map: SurfelMap, poses: np.ndarray, scale: float
) -> None:
    with pytest.raises(InputError):
        wide_map.predict_device(poses, scale)


CAMERA = Intrinsics(fx=71.3, fy=70.9, cx=39.5, cy=29.5, width=80, height=60)


def border_points(count):
    """Points that project to v = height or u = width up to rounding, (count, 3) float32."""
    rng = np.random.default_rng(0)
    z = rng.uniform(0.5, 5.0, count)
    u = np.where(np.arange(count) % 2, CAMERA.width, rng.integers(0, CAMERA.width, count))
    v = np.where(np.arange(count) % 2, CAMERA.height - 1, CAMERA.height)
    x = (u - CAMERA.cx) / CAMERA.fx * z
    y = (v - CAMERA.cy) / CAMERA.fy * z
    return np.stack([x, y, z], axis=1).astype(np.float32)


def test_nothing_is_written_behind_the_last_view():
    points = border_points(20_000)
    cloud = PointCloud()
    cloud.position = wp.array(points[None], dtype=wp.vec3)
    cloud.normal = wp.zeros((1, len(points)), dtype=wp.vec3)
    cloud.intensity = wp.zeros((1, len(points)), dtype=wp.float32)
    cloud.count = wp.array([len(points)], dtype=wp.int32)
    cloud.front_count = wp.array([len(points)], dtype=wp.int32)
    camera = SplatCamera()
    camera.focal = wp.vec2(CAMERA.fx, CAMERA.fy)
    camera.centre = wp.vec2(CAMERA.cx, CAMERA.cy)
    camera.width, camera.height, camera.z_near = CAMERA.width, CAMERA.height, 0.1
    size = CAMERA.width * CAMERA.height
    keys = wp.full(size + 4 * CAMERA.width, EMPTY, dtype=wp.int64)  # the surplus must stay empty
    motions = wp.array(np.eye(4, dtype=np.float32)[None], dtype=wp.mat44)
    wp.launch(scatter_points, dim=(1, 1), inputs=[cloud, 1, motions, camera, 1, keys])
    written = keys.numpy() != int(EMPTY)
    assert written[:size].any()
    assert not written[size:].any()


def test_projected_views_are_the_map_splatted_into_each(wide_map: SurfelMap) -> None:
    """Bit for bit, unlike views warped from one: the map rendered at each pose on its own."""
    views = wide_map.predict(CANDIDATES, singly=True)
    for pose, depth, intensity, normals in zip(
        CANDIDATES, views.depth, views.intensity, views.normals, strict=True
    ):
        direct = wide_map.render_model(device_poses(pose[None]))
        np.testing.assert_array_equal(depth, direct.vertices.numpy()[0, ..., 2])
        np.testing.assert_array_equal(intensity, direct.intensity.numpy()[0])
        np.testing.assert_array_equal(normals, direct.normals.numpy()[0])
    warped = wide_map.predict(CANDIDATES)
    true_depth = np.stack([ray_cast(pose, SMALL)[0] for pose in CANDIDATES])
    near_truth = [np.abs(each.depth - true_depth) < 0.002 for each in (views, warped)]
    assert near_truth[0].mean() > 0.9
    assert not np.array_equal(views.depth, warped.depth)
