"""The true surface that a sequence saw."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from box_scene import BOXES, ROOM_HIGH, ROOM_LOW, BoxScene

from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.evaluation.seen_surface import seen_surface, surface_in_views
from ms_slam_env.geometry import invert, look_at, transform_points
from ms_slam_env.scenes.mesh_queries import sample_surface
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.noise import NoiseConfig
from ms_slam_env.sequences import Sequence
from ms_slam_env.slam.surfel import SurfelConfig


def test_the_true_surface_reaches_as_far_as_the_sensor_and_slam_looks_farther():
    reach = inspect.signature(seen_surface).parameters["cutoff_m"].default
    assert reach == NoiseConfig().max_range_m <= SurfelConfig().depth_cutoff_m


def test_seen_surface_of_a_plane() -> None:
    intrinsics = xtion("80x60")
    depth = np.full(intrinsics.shape, 2.0, dtype=np.float32)
    depth[:, :10] = 5.5  # beyond the cutoff
    depth[:10] = 0.0  # no reading
    T = np.eye(4)
    T[:3, 3] = (1.0, 2.0, 3.0)
    frame = RGBDFrame(np.zeros((*depth.shape, 3), np.uint8), depth)
    points = seen_surface(Sequence((frame,), T[None], intrinsics, "plane"))
    np.testing.assert_allclose(points[:, 2], 5.0)
    left = 1.0 + 2.0 * (10 - intrinsics.cx) / intrinsics.fx
    top = 2.0 + 2.0 * (10 - intrinsics.cy) / intrinsics.fy
    np.testing.assert_allclose(points.min(axis=0)[:2], [left, top], atol=1e-6)


INSIDE = (np.asarray(ROOM_LOW) + np.asarray(ROOM_HIGH)) / 2


def test_surface_in_views_is_what_the_images_show(box_scene: BoxScene) -> None:
    camera = xtion("320x240")
    sensor = RGBDSensor(box_scene, camera, noise="none")
    aims = [np.array([*low[:2], 0.0]) for low, _ in BOXES] + [INSIDE + np.array([1.0, 0.2, -0.3])]
    eye = INSIDE + np.array([0.1, 0.05, 0.3])
    poses = np.stack([look_at(eye, aim) for aim in aims])
    depth_m, spacing_m = 2.5, 0.02
    points = surface_in_views(box_scene, poses, camera, depth_m, spacing_m)
    every = sample_surface(box_scene.mesh.vertices, box_scene.mesh.faces, spacing_m)[0]
    shares = []
    for cloud in (points, every):  # seen by a view: neither behind its reading nor out of range
        shown = np.zeros(len(cloud), bool)
        for pose in poses:
            depth = sensor.ground_truth(pose).depth
            local = transform_points(invert(pose), cloud)
            local[local[:, 2] <= 0] = (1e6, 1e6, 1.0)
            u, v = np.rint(camera.project(local)).astype(int).T
            inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            there = np.where(inside, depth[v.clip(0, 239), u.clip(0, 319)], 0.0)
            shown |= inside & (np.abs(there - local[:, 2]) < 0.03) & (local[:, 2] <= depth_m)
        shares.append(shown)
    assert shares[0].mean() > 0.99  # all but those at an edge, where a pixel shows what is beside
    assert shares[1].sum() == pytest.approx(len(points), rel=0.02)
    assert 0.1 < shares[1].mean() < 0.5


def test_a_wall_counts_by_its_area_however_often_it_is_seen(box_scene: BoxScene) -> None:
    camera, spacing_m = xtion("160x120"), 0.01
    wall = np.array([ROOM_HIGH[0], INSIDE[1], 2.0])
    poses = [look_at(wall - [d, 0, 0], wall) for d in (0.4, 0.8)]
    area = camera.width / camera.fx * camera.height / camera.fy
    for seen, distance in ((poses[:1], 0.4), (poses, 0.8), (3 * poses, 0.8)):
        points = surface_in_views(box_scene, np.stack(seen), camera, 1.0, spacing_m)
        np.testing.assert_allclose(points[:, 0], ROOM_HIGH[0], atol=1e-6)
        assert len(points) * spacing_m**2 == pytest.approx(area * distance**2, rel=0.01)
    assert len(surface_in_views(box_scene, np.stack(poses), camera, 0.3, spacing_m)) == 0
