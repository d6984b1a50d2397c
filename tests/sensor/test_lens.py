"""A sensor with a lens: every pixel sees what its bent ray meets."""

import dataclasses

import numpy as np
import pytest
from box_scene import BOXES, ROOM_HIGH, ROOM_LOW, BoxScene

from ms_slam_env.camera import Distortion, xtion
from ms_slam_env.camera.undistortion import undistort_depth
from ms_slam_env.geometry import look_at, transform_points
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.casters import WarpRayCaster
from ms_slam_env.sensor.embree_single import EmbreeSingleRayCaster
from ms_slam_env.sequences import LensDistortion, MotionBlur, RollingShutter, render_sequence

PLAIN = xtion("80x60")
K = dataclasses.replace(PLAIN, distortion=Distortion.of("radtan", [-0.25, 0.1, 0.004, -0.006]))
T = look_at([-1.5, -1.4, 1.3], [0.9, 0.6, 0.7])


def distance_to_a_plane(points):
    """Metres (...,) from the nearest plane of a wall or a box."""
    planes = np.stack([ROOM_LOW, ROOM_HIGH, *np.array(BOXES).reshape(-1, 3)])
    return np.abs(points[..., None, :] - planes).min(axis=(-2, -1))


@pytest.mark.parametrize("caster", ["embree", "single", "warp"])
def test_depth_lies_along_the_bent_rays(box_scene: BoxScene, caster: str) -> None:
    made = {
        "embree": lambda: None,
        "single": lambda: EmbreeSingleRayCaster(box_scene.mesh),
        "warp": lambda: WarpRayCaster(box_scene.mesh, "cpu"),
    }[caster]()
    sensor = RGBDSensor(box_scene, K, noise="none", caster=made)
    depth = sensor.capture(T, 0).depth
    assert (depth > 0).all()
    points = transform_points(T, K.rays() * depth[..., None])
    assert distance_to_a_plane(points).max() < 1e-4
    np.testing.assert_allclose(sensor.ground_truth(T).points, points, atol=1e-4)
    straight = transform_points(T, PLAIN.rays() * depth[..., None])
    assert distance_to_a_plane(straight).max() > 0.01  # it matters


def test_noise_keeps_to_the_bent_rays(box_scene: BoxScene) -> None:
    found = {}
    for name, camera in (("bent", K), ("plain", PLAIN)):
        sensor = RGBDSensor(box_scene, camera, noise="kinect")
        depths = np.stack([sensor.capture(T, index).depth for index in range(30)])
        true = sensor.ground_truth(T).depth
        read = (depths > 0).sum(axis=0) > 20
        error = np.where(depths > 0, depths - true, np.nan)[:, read]
        found[name] = np.median(np.nanmean(error, axis=0)), np.median(np.nanstd(error, axis=0))
    assert abs(found["bent"][0]) < 1e-3
    assert found["bent"][1] == pytest.approx(found["plain"][1], rel=0.15)


def test_the_perturbation_is_that_sensor(box_scene: BoxScene) -> None:
    lens = LensDistortion(-0.25, 0.1, 0.004, -0.006)
    path = np.stack([T, T])
    sequence = render_sequence(box_scene, path, PLAIN, "kinect", 3, perturbations=[lens])
    assert sequence.intrinsics == PLAIN
    truth = RGBDSensor(box_scene, K).capture(T, 1, 1 / 30, 3)
    np.testing.assert_array_equal(sequence.frames[1].depth, truth.depth)
    np.testing.assert_array_equal(sequence.frames[1].color, truth.color)
    plain = render_sequence(box_scene, path, PLAIN, "kinect", 3)
    off = render_sequence(box_scene, path, PLAIN, "kinect", 3, [LensDistortion(0.0, 0.0)])
    np.testing.assert_array_equal(off.frames[1].depth, plain.frames[1].depth)
    others = [lens, RollingShutter(0.03), MotionBlur()]
    still = render_sequence(box_scene, path, PLAIN, "none", perturbations=others).frames[1]
    np.testing.assert_array_equal(
        still.depth, RGBDSensor(box_scene, K, noise="none").capture(T, 1).depth
    )


def test_a_straightened_frame_is_that_of_a_camera_without_the_lens(box_scene: BoxScene) -> None:
    bent = RGBDSensor(box_scene, K, noise="none").capture(T, 0)
    plain = RGBDSensor(box_scene, PLAIN, noise="none").capture(T, 0)
    straight = undistort_depth(bent.depth, K)
    both = straight > 0
    assert both.mean() > 0.9
    before = np.median(np.abs(bent.depth - plain.depth))
    assert np.median(np.abs(straight - plain.depth)[both]) < 0.3 * before  # half a pixel is left
