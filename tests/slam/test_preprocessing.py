"""Preprocessing and pyramids against slow, obvious versions and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.slam.surfel.preprocessing import EDGE_FRACTION, SIGMA_PX, Preprocessor, Pyramid
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig

CAMERA = Intrinsics(fx=20.0, fy=21.0, cx=11.3, cy=7.7, width=24, height=16)
CONFIG = SurfelConfig(depth_cutoff_m=3.0, bilateral_radius_px=2)


def _random_frame(seed: int, camera: Intrinsics = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    depth = 1.5 + 0.02 * rng.normal(size=camera.shape) + rng.integers(0, 2, camera.shape) * 0.5
    depth[rng.random(camera.shape) < 0.15] = 0.0
    depth[rng.random(camera.shape) < 0.05] = 3.5
    color = rng.integers(0, 256, (*camera.shape, 3), dtype=np.uint8)
    return color, depth.astype(np.float32)


def _bilateral_along(inverse: np.ndarray, axis: int, config: SurfelConfig) -> np.ndarray:
    """One pixel and one neighbour at a time."""
    result = np.zeros_like(inverse)
    for index in np.ndindex(*inverse.shape):
        if inverse[index] == 0:
            continue
        weight_sum = value_sum = 0.0
        for offset in range(-config.bilateral_radius_px, config.bilateral_radius_px + 1):
            place = list(index)
            place[axis] += offset
            if not 0 <= place[axis] < inverse.shape[axis] or inverse[tuple(place)] == 0:
                continue
            near = inverse[tuple(place)]
            ratio = (near - inverse[index]) / (2 * config.bilateral_sigma_m)
            if abs(ratio) < 1:
                spatial = np.exp(-(offset**2) / (2 * SIGMA_PX**2))
                weight_sum += spatial * (1 - ratio**2) ** 2
                value_sum += spatial * (1 - ratio**2) ** 2 * near
        result[index] = value_sum / weight_sum
    return result


@given(seed=st.integers(0, 1000))
@settings(max_examples=5, deadline=None)
def test_filtered_depth_equals_the_slow_version(seed):
    color, depth = _random_frame(seed)
    live = Preprocessor(1, CAMERA, CONFIG)(color[None], depth[None])
    valid = (depth > 0) & (depth <= CONFIG.depth_cutoff_m)
    inverse = np.where(valid, 1 / np.where(valid, depth, 1), 0).astype(np.float64)
    filtered = _bilateral_along(_bilateral_along(inverse, 0, CONFIG), 1, CONFIG)
    expected = np.where(valid, 1 / np.where(valid, filtered, 1), 0)
    np.testing.assert_allclose(live.depth.numpy()[0], expected, rtol=2e-6)
    np.testing.assert_allclose(
        live.vertices.numpy()[0], CAMERA.rays() * expected[..., None], rtol=1e-5, atol=1e-6
    )
    np.testing.assert_array_equal(live.raw_depth.numpy()[0], depth)


def test_intensity_is_the_luma_of_the_color():
    color, depth = _random_frame(0)
    live = Preprocessor(1, CAMERA, CONFIG)(color[None], depth[None])
    expected = color @ np.array([0.299, 0.587, 0.114])
    np.testing.assert_allclose(live.intensity.numpy()[0], expected, atol=1e-3)
    np.testing.assert_array_equal(live.color.numpy()[0], color)


@given(a=st.floats(-0.6, 0.6), b=st.floats(-0.6, 0.6), distance=st.floats(0.8, 2.0))
@settings(max_examples=20, deadline=None)
def test_a_plane_keeps_its_depth_and_gets_its_normal(a, b, distance):
    normal = np.array([a, b, -1.0]) / np.sqrt(a * a + b * b + 1)
    depth = -distance / (CAMERA.rays() @ normal)
    color = np.zeros((*CAMERA.shape, 3), dtype=np.uint8)
    config = SurfelConfig(depth_cutoff_m=10.0, bilateral_sigma_m=1.0, normal_edge_per_m=1.0)
    live = Preprocessor(1, CAMERA, config)(color[None], depth.astype(np.float32)[None])
    inner = np.s_[2:-2, 2:-2]  # windows cut by the border are not symmetric
    np.testing.assert_allclose(live.depth.numpy()[0][inner], depth[inner], rtol=1e-5)
    normals = live.normals.numpy()[0][3:-3, 3:-3]
    np.testing.assert_allclose(normals, np.broadcast_to(normal, normals.shape), atol=2e-4)


def test_normals_face_the_camera_or_are_zero_and_edges_have_none():
    color, depth = _random_frame(3, xtion("80x60"))
    live = Preprocessor(1, xtion("80x60"), CONFIG)(color[None], depth[None])
    normals, vertices = live.normals.numpy()[0], live.vertices.numpy()[0]
    length = np.linalg.norm(normals, axis=-1)
    assert np.all((np.abs(length - 1) < 1e-5) | (length == 0))
    assert np.all((normals * vertices).sum(-1) <= 1e-6)
    assert np.all(length[live.depth.numpy()[0] == 0] == 0)

    step = np.full((60, 80), 1.0, dtype=np.float32)
    step[:, 40] = 0.0
    step[:, 39] = 2.0  # a lone column between a hole and another surface: no slope
    live = Preprocessor(1, xtion("80x60"), CONFIG)(color[None], step[None])
    assert not live.normals.numpy()[0][:, 39].any()


@pytest.mark.parametrize("distance", [0.15, 0.2])
def test_a_plane_close_by_has_normals_although_its_inverse_depth_is_steep(distance):
    camera, config = xtion("160x120"), SurfelConfig()
    normal = np.array([-np.sin(np.radians(60)), 0.0, -np.cos(np.radians(60))])
    rays = camera.rays()
    inverse = -(rays @ normal) / distance
    assert abs(inverse[0, 1] - inverse[0, 0]) > config.normal_edge_per_m  # as across an edge
    seen = (inverse > 1 / 3.0) & (inverse < 1 / 0.15)
    depth = np.where(seen, 1 / np.where(seen, inverse, 1), 0).astype(np.float32)
    live = Preprocessor(1, camera, config)(np.zeros((1, 120, 160, 3), np.uint8), depth[None])
    # Flatter than 80 degrees there may be none; at the border one neighbour is missing.
    cosine = -(rays @ normal) / np.linalg.norm(rays, axis=2)
    inside = (seen & (cosine > np.cos(np.radians(77))))[2:-2, 2:-2]
    assert inside.sum() > 1000
    found = live.normals.numpy()[0, 2:-2, 2:-2][inside]
    np.testing.assert_allclose(found @ normal, 1.0, atol=1e-4)


def _downsample(vertices: np.ndarray, intensity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    height, width = vertices.shape[0] // 2, vertices.shape[1] // 2
    coarse, grey = np.zeros((height, width, 3)), np.zeros((height, width))
    for v, u in np.ndindex(height, width):
        block = vertices[2 * v : 2 * v + 2, 2 * u : 2 * u + 2].reshape(4, 3)
        values = intensity[2 * v : 2 * v + 2, 2 * u : 2 * u + 2].reshape(4)
        valid = block[:, 2] > 0
        if not valid.any():
            grey[v, u] = values.mean()
            continue
        keep = valid & (block[:, 2] <= block[valid, 2].min() * (1 + EDGE_FRACTION))
        coarse[v, u], grey[v, u] = block[keep].mean(0), values[keep].mean()
    return coarse, grey


def test_pyramid_equals_the_slow_version_and_leaks_nothing_invalid():
    color, depth = _random_frame(1)
    live = Preprocessor(1, CAMERA, CONFIG)(color[None], depth[None])
    levels = Pyramid(1, [CAMERA.pyramid_level(n).shape for n in range(3)], True).build(
        live.vertices, live.normals, live.intensity
    )
    vertices, intensity = live.vertices.numpy()[0], live.intensity.numpy()[0]
    for level in levels[1:]:
        vertices, intensity = _downsample(vertices, intensity)
        np.testing.assert_allclose(level.vertices.numpy()[0], vertices, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(level.intensity.numpy()[0], intensity, rtol=1e-5)
        z = vertices[..., 2]
        assert np.all((z == 0) | (z > 1.3))  # a mean with an invalid 0 would lie nearer


def test_gradient_is_exact_on_a_ramp():
    v, u = np.mgrid[:16, :24].astype(np.float32)
    vertices = wp.zeros((1, 16, 24), dtype=wp.vec3)
    ramp = wp.array((3 * u - 2 * v)[None], dtype=wp.float32)
    (level,) = Pyramid(1, [(16, 24)], True).build(vertices, vertices, ramp)
    expected = np.stack([3 * u - 2 * v, np.full_like(u, 3), np.full_like(u, -2)], -1)
    np.testing.assert_allclose(level.gradient.numpy()[0], expected)
