"""The fused pass against a per-point loop and finite differences; known motions are recovered."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.geometry import invert, look_at, relative_angle, se3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.shared.alignment_check import TrackingStatus
from ms_slam_env.slam.surfel import normal_equations as aa
from ms_slam_env.slam.surfel.acceptance import acceptance_thresholds
from ms_slam_env.slam.surfel.normal_equations import accumulate_normal_equations
from ms_slam_env.slam.surfel.photometry import same_exposure
from ms_slam_env.slam.surfel.pose_hypotheses import NUM_HYPOTHESES, tracking_hypotheses
from ms_slam_env.slam.surfel.preprocessing import LiveFrame, Preprocessor
from ms_slam_env.slam.surfel.rendering import ModelView
from ms_slam_env.slam.surfel.solver import reduce_sums
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.tracker import Tracker, weights_of

SMALL = Intrinsics(fx=24.0, fy=24.0, cx=15.5, cy=11.5, width=32, height=24)
T_WORLD_MODEL = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])


LIGHT = same_exposure(1)
LIGHT["gain"], LIGHT["bias"], LIGHT["scale"], LIGHT["trust"] = 0.9, 9.0, 1.7, 0.6


def _weights(icp: float = 1.0, rgb: float = 1.0) -> aa.Weights:
    weights = aa.Weights()
    weights.icp, weights.rgb = icp, rgb
    weights.per_depth_noise = 1 / 0.003
    weights.per_cauchy_icp, weights.per_cauchy_rgb = 0.5, 1.0
    weights.grey_variance, weights.pixel_variance = 0.25, 0.09
    weights.distance_m, weights.cos_angle = 0.1, 0.7
    weights.inlier_sigmas, weights.conflict_sigmas = 4.0, 8.0
    weights.texture, weights.photometric_inlier = 4.0, 20.0
    weights.least_scale = 1.0
    return weights


def _synthetic(seed: int = 0) -> dict[str, np.ndarray]:
    """A wavy surface seen twice, with holes; smooth grey values."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: SMALL.height, : SMALL.width].astype(float)
    depth = 1.5 + 0.1 * np.sin(u / 7) + 0.05 * np.cos(v / 5)
    grey = 120 + 60 * np.sin(u / 3.1 + 0.4) + 40 * np.cos(v / 2.7)
    vertices = SMALL.rays() * depth[..., None]
    normal = np.cross(np.gradient(vertices, axis=1), np.gradient(vertices, axis=0))
    normal /= -np.linalg.norm(normal, axis=-1, keepdims=True)
    normal *= -np.sign((normal * vertices).sum(-1, keepdims=True))
    live = vertices + 0.002 * rng.normal(size=(*vertices.shape[:2], 1)) * SMALL.rays()
    live[rng.random(depth.shape) < 0.1] = 0
    model = vertices.copy()
    model[rng.random(depth.shape) < 0.1] = 0
    gy, gx = np.gradient(grey)
    return {
        "model_vertices": model, "model_normals": normal, "model_intensity": grey + 3.0,
        "live_vertices": live, "live_normals": normal,
        "live_gradient": np.stack([grey, gx, gy], -1),
    }  # fmt: skip


def _device_sums(data, T, weights, stride=1, columns=1 << 20, light=LIGHT):
    kinds = [wp.vec3, wp.vec3, wp.float32, wp.vec3, wp.vec3, wp.vec3]
    images = aa.AlignedImages()
    for (name, values), kind in zip(data.items(), kinds, strict=True):
        setattr(images, name, wp.array(values.astype(np.float32), dtype=kind).flatten())
    images.model_size = images.live_size = wp.vec2i(SMALL.width, SMALL.height)
    images.focal, images.centre = wp.vec2(SMALL.fx, SMALL.fy), wp.vec2(SMALL.cx, SMALL.cy)
    columns = min(columns, SMALL.width)
    rows, pieces = -(-SMALL.height // stride), -(-SMALL.width // columns)
    one = aa.Hypotheses()
    one.pose = wp.array(T[None, None], dtype=wp.mat44d)
    one.state = wp.array([[aa.RUNNING]], dtype=wp.int32)
    one.photometry = wp.array(light[:, None], dtype=aa.Photometry)
    one.partial = wp.zeros((1, 1, rows * pieces, aa.NUM_SUMS), dtype=wp.float32)
    one.sums = wp.zeros((1, 1, aa.NUM_SUMS), dtype=wp.float64)
    inputs = [images, weights, stride, columns, one]
    wp.launch(accumulate_normal_equations, dim=(1, 1, rows, pieces), inputs=inputs)
    wp.launch(reduce_sums, dim=one.sums.shape, inputs=[one, rows * pieces])
    return one.sums.numpy()[0, 0]


def _bilinear(image, x, y):
    u, v = int(x), int(y)
    a, b = x - u, y - v
    return (1 - b) * ((1 - a) * image[v, u] + a * image[v, u + 1]) + b * (
        (1 - a) * image[v + 1, u] + a * image[v + 1, u + 1]
    )


def _residuals(data, T, weights):
    """Residuals (r_icp, sigma) and (r_rgb, sigma) of every model point, one after another."""
    inverse = invert(T)
    icp, rgb = [], []
    for v, u in np.ndindex(SMALL.shape):
        p = data["model_vertices"][v, u]
        if p[2] <= 0:
            continue
        q = inverse[:3, :3] @ p + inverse[:3, 3]
        x, y = SMALL.project(q)
        if not (0 <= x < SMALL.width - 1 and 0 <= y < SMALL.height - 1):
            continue
        near = int(y + 0.5), int(x + 0.5)
        live = data["live_vertices"][near]
        if live[2] > 0:
            if abs(live[2] - q[2]) > weights.distance_m:
                continue
            n = inverse[:3, :3] @ data["model_normals"][v, u]
            if n @ data["live_normals"][near] > weights.cos_angle:
                icp.append((n @ (live - q), 0.003 * q[2] ** 2, near, (v, u)))
        seen = _bilinear(data["live_gradient"], x, y)
        if abs(seen[1]) + abs(seen[2]) > weights.texture:
            sigma = np.sqrt(0.25 + 0.09 * (seen[1] ** 2 + seen[2] ** 2))
            expected = np.clip(0.9 * data["model_intensity"][v, u] + 9.0, 0, 255)
            rgb.append((seen[0] - expected, sigma, seen, (v, u)))
    return icp, rgb


def _expected_system(data, T, weights):
    """H (2, 6, 6) and g (2, 6) of both terms with the Jacobians of the module's text."""
    inverse = invert(T)
    H, g = np.zeros((2, 6, 6)), np.zeros((2, 6))
    icp, rgb = _residuals(data, T, weights)
    for r, sigma, near, pixel in icp:
        n = inverse[:3, :3] @ data["model_normals"][pixel]
        J = np.concatenate([n, np.cross(data["live_vertices"][near], n)])
        w = weights.icp / sigma**2 / (1 + (r / sigma / 2) ** 2)
        H[0] += w * np.outer(J, J)
        g[0] += w * J * r
    for r, sigma, seen, pixel in rgb:
        q = inverse[:3, :3] @ data["model_vertices"][pixel] + inverse[:3, 3]
        to_q = np.array(
            [[SMALL.fx / q[2], 0, -SMALL.fx * q[0] / q[2] ** 2],
             [0, SMALL.fy / q[2], -SMALL.fy * q[1] / q[2] ** 2]]
        )  # fmt: skip
        slope = -seen[1:] @ to_q
        J = np.concatenate([slope, np.cross(q, slope)])
        w = weights.rgb * 0.6 / 1.7**2 / sigma**2 / (1 + (r / sigma / 1.7) ** 2)
        H[1] += w * np.outer(J, J)
        g[1] += w * J * r
    return H, g, len(icp), len(rgb)


@pytest.mark.parametrize("columns", [1 << 20, 7])
def test_normal_equations_equal_the_loop_over_points(columns):
    data, weights = _synthetic(), _weights()
    T = se3_exp([0.01, -0.02, 0.015, 0.01, 0.02, -0.015])
    sums = _device_sums(data, T, weights, columns=columns)
    H, g, num_icp, num_rgb = _expected_system(data, T, weights)
    assert num_icp > 300
    assert num_rgb == sums[aa.Sum.TEXTURED]
    for term, first in enumerate((0, aa.Sum.PHOTOMETRIC_HESSIAN)):
        scale = np.sqrt(np.diag(H[term]))
        actual = np.zeros((6, 6))
        actual[np.triu_indices(6)] = sums[first : first + 21]
        actual = np.triu(actual) + np.triu(actual, 1).T
        both = np.outer(scale, scale)
        np.testing.assert_allclose(actual / both, H[term] / both, atol=2e-4)
        expected = g[term] / scale
        actual = sums[first + 21 : first + 27] / scale
        np.testing.assert_allclose(actual, expected, atol=2e-3 * np.abs(expected).max())


def _expected_counts(data, T, config: SurfelConfig):
    """Places of ``Sum`` whose values are numbers of points, by the rules of ``config``."""
    counts, inverse, rules = Counter(), invert(T), config.acceptance
    for v, u in np.argwhere(data["model_vertices"][..., 2] > 0):
        counts[aa.Sum.POINTS] += 1
        q = inverse[:3, :3] @ data["model_vertices"][v, u] + inverse[:3, 3]
        x, y = SMALL.project(q)
        if not (0 <= x < SMALL.width - 1 and 0 <= y < SMALL.height - 1):
            continue
        counts[aa.Sum.VISIBLE] += 1
        near = int(y + 0.5), int(x + 0.5)
        live = data["live_vertices"][near]
        gap = abs(live[2] - q[2])
        is_other = live[2] > 0 and gap > config.icp_distance_m
        if live[2] > 0:
            sigma = config.depth_noise_m * q[2] ** 2
            n = inverse[:3, :3] @ data["model_normals"][v, u]
            angle_deg = np.degrees(np.arccos(n @ data["live_normals"][near]))
            is_near = not is_other and angle_deg < config.icp_angle_deg
            counts[aa.Sum.MATCHED] += 1
            counts[aa.Sum.INLIERS] += is_near and abs(n @ (live - q)) < rules.inlier_sigmas * sigma
            counts[aa.Sum.DEPTH_CONFLICTS] += gap > rules.conflict_sigmas * sigma
        grey, *slope = _bilinear(data["live_gradient"], x, y)
        if not is_other and np.abs(slope).sum() > rules.texture:
            residual = abs(grey - np.clip(data["model_intensity"][v, u], 0, 255))
            counts[aa.Sum.TEXTURED] += 1
            counts[aa.Sum.PHOTOMETRIC_INLIERS] += residual < rules.photometric_inlier
    return counts


@pytest.mark.parametrize(
    "changed",
    [{}, {"inlier_sigmas": 2.0}, {"conflict_sigmas": 4.0}, {"texture": 12.0},
     {"photometric_inlier": 10.0}],
)  # fmt: skip
def test_the_points_that_fit_are_those_that_the_options_name(changed):
    """Half of the points are inliers here: with 99 % of them no test sees a rule that is off."""
    acceptance = replace(SurfelConfig().acceptance, **changed)
    config = SurfelConfig(acceptance=acceptance)
    data, T = _synthetic(), se3_exp([0.02, -0.02, 0.03, 0.01, 0.02, -0.015])
    errors = np.random.default_rng(1).normal(0, 0.03, (*SMALL.shape, 1))
    data["live_vertices"] = data["live_vertices"] * (1 + errors)
    sums = _device_sums(data, T, weights_of(config, 0), light=same_exposure(1))
    expected = _expected_counts(data, T, config)
    assert {place: sums[place] for place in expected} == expected
    if not changed:
        assert 0.3 < expected[aa.Sum.INLIERS] / expected[aa.Sum.MATCHED] < 0.8
        assert 0.3 < expected[aa.Sum.PHOTOMETRIC_INLIERS] / expected[aa.Sum.TEXTURED] < 0.9


@pytest.mark.parametrize("term", ["icp", "rgb"])
def test_jacobians_agree_with_finite_differences(term):
    """A residual's change under T <- T exp(xi) is J xi, while its pixel stays the same."""
    data, weights = _synthetic(), _weights()
    # A grey value linear in the image makes the interpolated gradient exact everywhere.
    v, u = np.mgrid[: SMALL.height, : SMALL.width].astype(float)
    data["live_gradient"] = np.stack([3 * u + 2 * v, np.full_like(u, 3), np.full_like(u, 2)], -1)
    T = se3_exp([0.01, -0.02, 0.015, 0.01, 0.02, -0.015])
    index = 0 if term == "icp" else 1
    before = {r[3]: r for r in _residuals(data, T, weights)[index]}
    inverse = invert(T)
    checked = 0
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = 1e-6
        after = {r[3]: r for r in _residuals(data, T @ se3_exp(xi), weights)[index]}
        for pixel, (r, _, where, _) in before.items():
            if pixel not in after or (term == "icp" and after[pixel][2] != where):
                continue
            if term == "icp":
                n = inverse[:3, :3] @ data["model_normals"][pixel]
                J = np.concatenate([n, np.cross(data["live_vertices"][where], n)])
            else:
                q = inverse[:3, :3] @ data["model_vertices"][pixel] + inverse[:3, 3]
                g = np.array([3 * SMALL.fx, 2 * SMALL.fy, 0]) / q[2]
                g[2] = -(g[0] * q[0] + g[1] * q[1]) / q[2]
                J = -np.concatenate([g, np.cross(q, g)])
            assert (after[pixel][0] - r) / 1e-6 == pytest.approx(J[axis], rel=1e-3, abs=1e-2)
            checked += 1
    assert checked > 1000


def test_stride_looks_at_a_chessboard_of_points():
    data, weights = _synthetic(), _weights()
    rows = np.arange(0, SMALL.height, 2)
    columns = [np.arange(i % 2, SMALL.width, 2) for i in range(len(rows))]
    expected = sum(
        (data["model_vertices"][v, c, 2] > 0).sum() for v, c in zip(rows, columns, strict=True)
    )
    assert _device_sums(data, np.eye(4), weights, stride=2)[aa.Sum.POINTS] == expected


class _Pair:
    """A tracker, and the scene's sensor without noise."""

    def __init__(self, noise: str = "none") -> None:
        self.camera = xtion("160x120")
        self.sensor = RGBDSensor(BoxScene(), self.camera, noise=noise)
        config = SurfelConfig(depth_cutoff_m=5.0)
        self.preprocessors = [Preprocessor(1, self.camera, config) for _ in range(2)]
        self.tracker = Tracker(1, NUM_HYPOTHESES, self.camera, config)

    def live(self, which: int, pose: np.ndarray) -> LiveFrame:
        frame = self.sensor.capture(pose, which)
        return self.preprocessors[which](frame.color[None], frame.depth[None])

    def align(self, model: LiveFrame, live: LiveFrame):
        view = ModelView(model.vertices, model.normals, model.intensity, model.color)
        self.tracker.set_frame(live)
        thresholds = acceptance_thresholds(
            SurfelConfig().acceptance, np.zeros(1, dtype=bool), np.zeros(1, dtype=np.int32)
        )
        hypotheses = tracking_hypotheses(np.eye(4))[None]
        return self.tracker.align(view, T_WORLD_MODEL[None], hypotheses, thresholds)


@pytest.fixture(scope="module")
def pair() -> _Pair:
    return _Pair()


@pytest.mark.parametrize(
    "twist",
    [
        np.zeros(6),
        [0.01, 0, 0, 0, 0.01, 0],
        [0.06, 0, 0, 0, 0, np.radians(6)],
        [0, 0, 0.06, np.radians(-6), 0, 0],
        [0, 0.1, 0, 0, np.radians(10), 0],
        [-0.1, 0, 0, 0, 0, np.radians(-10)],
    ],
)
def test_known_motions_are_recovered(pair, twist):
    truth = T_WORLD_MODEL @ se3_exp(twist)
    alignment = pair.align(pair.live(0, T_WORLD_MODEL), pair.live(1, truth))
    assert alignment.tracked.all()
    estimate = alignment.T_world_live[0]
    assert np.linalg.norm(estimate[:3, 3] - truth[:3, 3]) < 0.006
    assert relative_angle(estimate[:3, :3], truth[:3, :3]) < np.radians(0.3)
    np.testing.assert_allclose(T_WORLD_MODEL @ alignment.T_model_live[0], estimate, atol=1e-12)


@pytest.mark.parametrize("twist", [[0.01, 0, 0, 0, 0.01, 0], [-0.1, 0, 0, 0, 0, np.radians(-10)]])
def test_all_iterations_of_a_level_at_once_are_those_of_single_launches(pair, twist):
    model, live = pair.live(0, T_WORLD_MODEL), pair.live(1, T_WORLD_MODEL @ se3_exp(twist))
    assert pair.tracker.gauss_newton.at_once
    at_once = pair.align(model, live)
    try:
        pair.tracker.gauss_newton.at_once = False
        one_by_one = pair.align(model, live)
    finally:
        pair.tracker.gauss_newton.at_once = True
    for name, values in vars(at_once).items():
        assert values.tobytes() == getattr(one_by_one, name).tobytes(), name


def test_a_frame_without_depth_has_too_few_points(pair):
    model = pair.live(0, T_WORLD_MODEL)
    black = np.zeros((1, *pair.camera.shape, 3), dtype=np.uint8)
    live = pair.preprocessors[1](black, np.zeros((1, *pair.camera.shape), dtype=np.float32))
    assert pair.align(model, live).status[0] == TrackingStatus.FEW_POINTS


def test_foreign_colours_do_not_fit(pair):
    model = pair.live(0, T_WORLD_MODEL)
    frame = pair.sensor.capture(T_WORLD_MODEL, 1)
    noise = np.random.default_rng(0).integers(0, 256, (1, *pair.camera.shape, 3), dtype=np.uint8)
    live = pair.preprocessors[1](noise, frame.depth[None])
    assert pair.align(model, live).status[0] == TrackingStatus.PHOTOMETRIC_MISMATCH
