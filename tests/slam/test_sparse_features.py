"""Features, matching, patches and bookkeeping of the sparse backend."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from surfel_scenes import WALL_NORMAL, WALL_POINT

from ms_slam_env.camera import intensity_image, xtion
from ms_slam_env.geometry import invert, make_pose, se3_exp, so3_exp
from ms_slam_env.slam.shared.alignment_measures import DepthImage
from ms_slam_env.slam.shared.feature_matching import (
    hamming_distance,
    match_anywhere,
    match_near,
    most_alike,
    thumbnail,
)
from ms_slam_env.slam.shared.orb_features import FeatureExtractor, Features, InverseDepth
from ms_slam_env.slam.sparse.patches import Patches, cut, find_patches, warp
from ms_slam_env.slam.sparse.sparse_map import Keyframe, SparseMap

CAMERA = xtion("160x120")


def _wall(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth and intensity (H, W) of a plane with a texture of waves of about 8 cm."""
    rays = CAMERA.rays() @ pose[:3, :3].T
    depth = (WALL_POINT - pose[:3, 3]) @ WALL_NORMAL / (rays @ WALL_NORMAL)
    x, y, _ = np.moveaxis(pose[:3, 3] + depth[..., None] * rays, -1, 0)
    waves = np.sin(70 * x + 9 * y) + np.sin(60 * y - 20 * x) + np.sin(45 * (x + y))
    return depth.astype(np.float32), (128 + 35 * waves).astype(np.float32)


def _descriptors(count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 2**64, (count, 4), dtype=np.uint64)


def _flip(descriptors: np.ndarray, bits: int, rng: np.random.Generator) -> np.ndarray:
    """The same descriptors with some bits turned over."""
    flat = np.unpackbits(descriptors.view(np.uint8), axis=1)
    for row in flat:
        row[rng.choice(256, bits, replace=False)] ^= 1
    return np.packbits(flat, axis=1).view(np.uint64)


def test_hamming_distance_counts_bits():
    rng = np.random.default_rng(0)
    a, b = _descriptors(20, rng), _descriptors(20, rng)
    bits = np.unpackbits(a.view(np.uint8), axis=1) != np.unpackbits(b.view(np.uint8), axis=1)
    np.testing.assert_array_equal(hamming_distance(a, b), bits.sum(axis=1))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_points_match_the_features_that_were_theirs(seed):
    rng = np.random.default_rng(seed)
    count = 60
    grid = np.stack(np.meshgrid(np.arange(10) * 15.0, np.arange(6) * 15.0), -1).reshape(-1, 2)
    wanted = _descriptors(count, rng)
    order = rng.permutation(count)
    pixels = (grid + rng.uniform(-2, 2, grid.shape))[order]
    found = _flip(wanted, 20, rng)[order]
    points, features = match_near(grid, wanted, cKDTree(pixels), found, 5.0, 50)
    assert len(points) == count
    np.testing.assert_array_equal(order[features], points)
    points, features = match_anywhere(wanted, found, 50)
    np.testing.assert_array_equal(order[features], points)
    points, _ = match_near(grid, wanted, cKDTree(pixels), found, 5.0, 10)  # too strict
    assert len(points) == 0


def test_nothing_matches_nothing():
    none = np.zeros((0, 4), dtype=np.uint64)
    some = _descriptors(3, np.random.default_rng(0))
    tree = cKDTree(np.zeros((3, 2)))
    for pair in (
        match_anywhere(none, some, 60),
        match_anywhere(some, none, 60),
        match_near(np.zeros((0, 2)), none, tree, some, 5.0, 60),
    ):
        assert [len(indices) for indices in pair] == [0, 0]


def test_inverse_depth_of_a_plane_is_exact_between_pixels():
    pose = make_pose(so3_exp([0.1, -0.2, 0.05]), [0.1, 0.0, 0.2])
    depth, _ = _wall(pose)
    rng = np.random.default_rng(0)
    pixels = rng.uniform([5, 5], [154, 114], (200, 2))
    inverse = InverseDepth(depth)
    rays = np.ones((200, 3))
    rays[:, :2] = (pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    truth = (rays @ pose[:3, :3].T @ WALL_NORMAL) / ((WALL_POINT - pose[:3, 3]) @ WALL_NORMAL)
    np.testing.assert_allclose(inverse.at(pixels), truth, atol=1e-5)
    slope = inverse.slope(pixels)
    np.testing.assert_allclose(slope, np.broadcast_to(slope[0], slope.shape), atol=1e-5)
    depth[40:60] = 0
    depth[80:, 80:] = 0.5  # before the wall: an edge
    inverse = InverseDepth(depth)
    assert inverse.at(np.array([[50.3, 50.2], [100.0, 80.0], [80.0, 100.0]])).tolist() == [0, 0, 0]
    np.testing.assert_allclose(inverse.at(np.array([[120.0, 100.0]])), 2.0)


def test_features_spread_over_the_image_and_know_their_depth():
    depth, intensity = _wall(np.eye(4))
    extract = FeatureExtractor(CAMERA, features=300)
    features = extract(intensity.astype(np.uint8), InverseDepth(depth))
    assert 200 < len(features) <= 300
    assert (features.pixels >= 0).all()
    assert (features.pixels <= [159, 119]).all()
    cells = (features.pixels // 40).astype(int)
    assert len(np.unique(cells, axis=0)) >= 10  # of 12; the wall's near corner is smooth
    points = features.points(CAMERA)
    np.testing.assert_allclose((points - WALL_POINT) @ WALL_NORMAL, 0, atol=2e-3)
    blank = extract(np.full(CAMERA.shape, 90, dtype=np.uint8), InverseDepth(depth))
    assert len(blank) == 0


def _patches(
    pixels: np.ndarray, depth: np.ndarray, motion: np.ndarray, shift: np.ndarray
) -> Patches:
    inverse = InverseDepth(depth)
    motions = np.broadcast_to(motion, (len(pixels), 4, 4))
    return Patches(pixels, inverse.at(pixels), inverse.slope(pixels), motions, shift)


def test_patches_are_found_to_a_fraction_of_a_pixel():
    host, pose = np.eye(4), se3_exp([0.08, -0.03, 0.12, 0.03, 0.06, 0.15])
    depth, intensity = _wall(host)
    _, there = _wall(pose)
    rng = np.random.default_rng(0)
    pixels = rng.uniform([30, 30], [130, 90], (80, 2))
    rays = np.ones((80, 3))
    rays[:, :2] = (pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    points = rays / InverseDepth(depth).at(pixels)[:, None]
    truth = CAMERA.project((points - pose[:3, 3]) @ pose[:3, :3])
    patches = _patches(pixels, depth, invert(pose) @ host, rng.uniform(-0.7, 0.7, (80, 2)))
    centre, distortion = warp(patches, CAMERA)
    np.testing.assert_allclose(centre, truth, atol=1e-2)
    turn = np.degrees(np.arctan2(distortion[:, 1, 0], distortion[:, 0, 0]))
    assert abs(np.median(turn) + np.degrees(0.15)) < 2
    brighter = there + 15  # as after a change of exposure
    found, sigma = find_patches(brighter, cut(intensity, pixels), patches, CAMERA)
    sure = np.isfinite(sigma)
    assert sure.mean() > 0.7
    error = np.linalg.norm(found - truth, axis=1)[sure]
    assert np.median(error) < 0.08
    assert np.percentile(error, 95) < 0.3


def test_patches_that_are_not_there_are_not_found():
    depth, intensity = _wall(np.eye(4))
    pixels = np.random.default_rng(0).uniform([30, 30], [130, 90], (80, 2))
    patches = _patches(pixels, depth, np.eye(4), np.zeros((80, 2)))
    noise = np.random.default_rng(1).uniform(0, 255, CAMERA.shape).astype(np.float32)
    _, sigma = find_patches(noise, cut(intensity, pixels), patches, CAMERA)
    assert np.isfinite(sigma).mean() < 0.05
    blank = np.full(CAMERA.shape, 90, dtype=np.float32)
    _, sigma = find_patches(blank, cut(blank, pixels), patches, CAMERA)
    assert not np.isfinite(sigma).any()


def test_behind_the_camera_there_is_no_patch():
    depth, intensity = _wall(np.eye(4))
    pixels = np.array([[80.0, 60.0]])
    turned = _patches(pixels, depth, make_pose(so3_exp([0, np.pi, 0]), [0, 0, 0]), np.zeros((1, 2)))
    _, sigma = find_patches(intensity, cut(intensity, pixels), turned, CAMERA)
    assert np.isinf(sigma).all()


def test_like_images_are_alike():
    images = []
    for turn in (0.0, 0.03, 0.5):
        depth, intensity = _wall(make_pose(so3_exp([0, turn, 0]), [0, 0, 0]))
        intensity = intensity * np.linspace(0.5, 1.0, 160, dtype=np.float32)
        images.append(thumbnail(DepthImage(depth, np.roll(intensity, int(300 * turn), axis=1))))
    assert most_alike(images[0], images, 3)[:2] == [0, 1]
    assert most_alike(images[0], [], 3) == []
    np.testing.assert_allclose(np.linalg.norm(images[0]), 1, atol=1e-3)


def _map(rng: np.random.Generator) -> SparseMap:
    """Two keyframes of ten features each, the last five of the second seen by both."""
    sparse_map = SparseMap(CAMERA)
    depth, intensity = _wall(np.eye(4))
    color = np.repeat(intensity_image(intensity.astype(np.uint8))[..., None], 3, axis=2)
    for k in range(2):
        pixels = rng.uniform([10, 10], [150, 110], (10, 2))
        features = Features(pixels, np.full(10, 0.5), _descriptors(10, rng), np.ones(10))
        ids = np.full(10, -1)
        if k == 1:
            ids[5:] = np.arange(5)
        pose = make_pose(np.eye(3), [0.1 * k, 0, 0])
        sparse_map.add(Keyframe(pose, k == 0, k, features, ids, color, intensity, depth))
    return sparse_map


@pytest.mark.parametrize("keyframes", [1, 12])
def test_neighbours_are_those_with_most_features_on_points_of_a_keyframe(keyframes: int) -> None:
    rng = np.random.default_rng(keyframes)
    sparse_map = SparseMap(CAMERA)
    sparse_map.positions = np.zeros((40, 3))
    ids = [rng.integers(-1, 40, rng.integers(0, 30)) for _ in range(keyframes)]
    sparse_map.keyframes = [
        SimpleNamespace(point_ids=one, seen_points=lambda one=one: one[one >= 0]) for one in ids
    ]
    slow = []
    for k, mine in enumerate(ids):
        shared = [sum(i >= 0 and i in mine for i in other) for other in ids]
        others = sorted((j for j in range(keyframes) if j != k), key=lambda j: -shared[j])
        slow.append([j for j in others[:5] if shared[j] >= 6])
    assert [sparse_map.neighbours(k, 5, 6) for k in range(keyframes)] == slow
    assert sparse_map.neighbours_of_each(range(keyframes), 5, 6) == slow
    assert sparse_map.neighbours_of_each([], 5) == []
    assert sparse_map.shared(np.array([1, 2]), []).tolist() == []


def test_keyframes_share_points_take_them_along_and_merge_them():
    sparse_map = _map(np.random.default_rng(0))
    assert len(sparse_map.positions) == 15
    assert sparse_map.hosts.tolist() == [0] * 10 + [1] * 5
    assert sparse_map.neighbours(0, 5, least=5) == [1]
    assert sparse_map.neighbours(0, 5, least=6) == []
    np.testing.assert_allclose(sparse_map.positions[:, 2], 2.0)
    before = sparse_map.positions.copy()
    motion = make_pose(np.eye(3), [0.0, 0.5, 0.0])
    sparse_map.move({1: motion @ sparse_map.keyframes[1].T_world_camera})
    np.testing.assert_allclose(sparse_map.positions[:10], before[:10])
    np.testing.assert_allclose(sparse_map.positions[10:] - before[10:], [[0.0, 0.5, 0.0]] * 5)
    sparse_map.merge(np.array([7]), np.array([12]))
    assert not sparse_map.alive[12]
    assert 7 in sparse_map.keyframes[1].seen_points()
    assert 12 not in sparse_map.points_of([0, 1])


def test_points_never_found_again_are_dropped():
    sparse_map = _map(np.random.default_rng(0))
    tried, found = np.array([2, 3]), np.array([3])
    for _ in range(20):
        sparse_map.count_sightings(tried, found)
    assert not sparse_map.alive[2]
    assert sparse_map.alive[3]
