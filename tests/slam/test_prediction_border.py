"""Points that project onto the border of the last predicted view stay inside its memory."""

import numpy as np

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel.surfels import SplatCamera
from ms_slam_env.slam.surfel.view_warping import EMPTY, PointCloud, scatter_points

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
