"""The information matrix against finite differences of the residuals that SLAM minimises."""

import numpy as np

from ms_slam_env.camera import xtion
from ms_slam_env.geometry import invert, se3_exp, transform_points
from ms_slam_env.mapping import view_information
from ms_slam_env.slam.base import Views

K = xtion("80x60").scaled(0.5)


def plane_views(normal, distance, texture):
    """A view of the plane n . p = -distance, with grey values as a function of its points."""
    rays = K.rays()
    normal = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    depth = -distance / (rays @ normal)
    points = rays * depth[..., None]
    normals = np.broadcast_to(normal, points.shape)
    grey = texture(points)
    as_views = (grey[None], depth[None], normals[None])
    return Views(*(np.ascontiguousarray(a, dtype=np.float32) for a in as_views), K), points, normal


def numeric(residuals, length):
    """(n, 6) central differences along translation and rotation times ``length``."""
    columns = []
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6 if axis < 3 else 1e-6 / length
        columns.append((residuals(se3_exp(step)) - residuals(se3_exp(-step))) / 2e-6)
    return np.stack(columns, axis=1)


def test_geometry_alone():
    views, points, normal = plane_views([0.2, -0.3, -1.0], 1.5, lambda p: 0 * p[..., 0] + 100)
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


def test_texture_tells_the_directions_that_a_plane_leaves_open():
    plain, *_ = plane_views([0, 0, -1.0], 1.5, lambda p: 0 * p[..., 0] + 100)
    waves = lambda p: 100 + 50 * np.sin(3 * p[..., 0]) * np.cos(4 * p[..., 1])  # noqa: E731
    textured, points, _ = plane_views([0, 0, -1.0], 1.5, waves)
    open_, closed = (np.linalg.eigvalsh(view_information(v)[0]) for v in (plain, textured))
    assert (open_[:3] < 1e-6 * open_[-1]).all()
    assert (closed[:3] > 1e-4 * closed[-1]).all()

    def residuals(motion):  # grey values that the moved camera's pixels see, errors of 8 levels
        rays = K.rays()[1:-1, 1:-1].reshape(-1, 3) @ motion[:3, :3].T
        hit = motion[:3, 3] + rays * ((1.5 - motion[2, 3]) / rays[:, 2])[:, None]
        return waves(hit) / 8.0

    J = numeric(residuals, points[..., 2].mean())
    found = view_information(textured)[0] - view_information(plain)[0]
    expected = J.T @ J
    np.testing.assert_allclose(found, expected, atol=0.02 * np.trace(expected))


def test_an_empty_view_tells_nothing():
    empty = np.zeros((2, 30, 40), np.float32)
    views = Views(empty, empty, np.zeros((2, 30, 40, 3), np.float32), K)
    assert not view_information(views).any()
