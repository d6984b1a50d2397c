"""The information matrix against finite differences of the residuals that SLAM minimises."""

import numpy as np
import pytest

from ms_slam_env.camera import xtion
from ms_slam_env.geometry import invert, se3_exp, transform_points
from ms_slam_env.planning import view_information
from ms_slam_env.planning.trackability import remaining
from ms_slam_env.slam.slam_backend import Views

K = xtion("80x60").scaled(0.5)


def plane_views(normal, distance):
    """A view of the plane n . p = -distance, its points and normal."""
    rays = K.rays()
    normal = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    depth = -distance / (rays @ normal)
    points = rays * depth[..., None]
    normals = np.broadcast_to(normal, points.shape)
    as_views = (0 * depth[None], depth[None], normals[None])
    return Views(*(np.ascontiguousarray(a, dtype=np.float32) for a in as_views), K), points, normal


def numeric(residuals, length):
    """(n, 6) central differences along translation and rotation times ``length``."""
    columns = []
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6 if axis < 3 else 1e-6 / length
        columns.append((residuals(se3_exp(step)) - residuals(se3_exp(-step))) / 2e-6)
    return np.stack(columns, axis=1)


def test_it_is_that_of_point_to_plane_residuals():
    views, points, normal = plane_views([0.2, -0.3, -1.0], 1.5)
    z = points[..., 2].ravel()
    sigma = 0.0012 + 0.0019 * np.maximum(z - 0.4, 0) ** 2

    def residuals(motion):  # of the points seen from a camera that moved by ``motion``
        moved = transform_points(invert(motion), points.reshape(-1, 3))
        return (moved - points.reshape(-1, 3)) @ normal / sigma

    J = numeric(residuals, z.mean())
    expected = J.T @ J
    np.testing.assert_allclose(
        view_information(views)[0], expected, rtol=1e-3, atol=1e-4 * np.trace(expected)
    )


def test_a_plane_leaves_three_directions_open_and_a_corner_none():
    plane, *_ = plane_views([0, 0, -1.0], 1.5)
    least = np.linalg.eigvalsh(view_information(plane)[0])
    assert (least[:3] < 1e-6 * least[-1]).all()
    assert (least[3:] > 1e-3 * least[-1]).all()
    walls = [plane_views(n, 1.5)[0] for n in ([0.6, 0, -0.8], [-0.6, 0.1, -0.8], [0, -0.7, -0.7])]
    corner = sum(view_information(wall)[0] for wall in walls)
    assert np.linalg.eigvalsh(corner)[0] > 1e-3 * np.linalg.eigvalsh(corner)[-1]


def test_an_empty_view_tells_nothing():
    empty = np.zeros((2, 30, 40), np.float32)
    views = Views(empty, empty, np.zeros((2, 30, 40, 3), np.float32), K)
    assert not view_information(views).any()


def test_what_remains_of_a_view_is_counted_pixel_by_pixel():
    views, points, normal = plane_views([0.2, -0.3, -1.0], 0.5)
    views.depth[0, :20] = 0
    there = np.stack([np.eye(4), se3_exp(np.array([0.05, -0.02, 0.1, 0.05, -0.1, 0.02]))])
    H, remains, near = remaining(views, there)
    np.testing.assert_allclose(H[0], view_information(views)[0], rtol=1e-4, atol=1e-5 * H[0].max())
    length = views.depth[views.depth > 0].mean()
    for k, T_here_there in enumerate(there):
        T = invert(T_here_there)
        expected, seen, seen_near = np.zeros((6, 6)), 0, 0
        for v, u in zip(*np.nonzero(views.depth[0]), strict=True):
            p, n = transform_points(T, points[v, u][None])[0], T[:3, :3] @ normal
            x, y = K.fx * p[0] / p[2] + K.cx, K.fy * p[1] / p[2] + K.cy
            if -0.5 < x < K.width - 0.5 and -0.5 < y < K.height - 0.5:
                J = np.concatenate([n, np.cross(p, n) / length])
                expected += np.outer(J, J) / (0.0012 + 0.0019 * max(p[2] - 0.4, 0) ** 2) ** 2
                seen, seen_near = seen + 1, seen_near + (p[2] < 0.5)
        pixels = views.depth[0].size
        assert remains[k] == pytest.approx(seen / pixels, abs=2 / pixels)  # single precision
        assert near[k] == pytest.approx(seen_near / pixels, abs=2 / pixels)
        np.testing.assert_allclose(H[k], expected, rtol=1e-2, atol=1e-3 * np.abs(expected).max())
    assert 0 < remains[1] < remains[0]
    assert 0 < near[0] < remains[0]
