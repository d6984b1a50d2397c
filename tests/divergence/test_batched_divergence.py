"""The interface of the three variants on batches of frames."""

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.stats import wasserstein_distance

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import xtion
from ms_slam_env.config import from_dict
from ms_slam_env.divergence import (
    MEASURES,
    DivergenceConfig,
    Histograms,
    depth_divergence,
    intensity_divergence,
    make_divergence,
    ms_parameters,
)
from ms_slam_env.divergence.measures import SphereTransport, earth_movers_1d
from ms_slam_env.divergence.sphere import bin_directions, bin_weights
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import so3_exp

CAMERA = xtion("80x60")


def frames(count, seed=0):
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:60, :80]
    slopes = rng.normal(0, 0.004, (count, 2, 1, 1))
    inverse = 0.5 + slopes[:, 0] * (u - 40) + slopes[:, 1] * (v - 30)
    inverse += rng.normal(0, 0.002, inverse.shape)
    depth = (1 / np.clip(inverse, 0.2, 2)).astype(np.float32)
    depth[:, :5, :7] = 0
    mean = rng.uniform(60, 180, (count, 1, 1))
    intensity = np.clip(np.rint(rng.normal(mean, 30, depth.shape)), 0, 255).astype(np.float32)
    return intensity, depth


def test_batch_equals_pairwise_functions():
    intensity, depth = frames(4)
    divergence = make_divergence(DivergenceConfig.paper(), CAMERA)
    histograms = divergence.histograms(intensity, depth)
    found = divergence.divergence(histograms, histograms[0])
    assert found.shape == (4, 2)
    images = intensity.astype(np.uint8)
    for k in range(4):
        assert found[k, 0] == pytest.approx(intensity_divergence(images[k], images[0]), rel=1e-9)
        assert found[k, 1] == pytest.approx(depth_divergence(depth[k], depth[0], CAMERA), rel=1e-6)


@pytest.mark.parametrize("measure", MEASURES)
def test_every_measure_is_a_divergence(measure):
    intensity, depth = frames(5)
    divergence = make_divergence(DivergenceConfig(measure=measure), CAMERA)
    histograms = divergence.histograms(intensity, depth)
    assert len(histograms) == 5
    np.testing.assert_allclose(histograms.intensity.sum(axis=-1), 1)
    np.testing.assert_allclose(histograms.normals.sum(axis=-1), 1)
    found = divergence.divergence(histograms, histograms[2])
    np.testing.assert_allclose(found[2], 0, atol=1e-12)
    assert (found[[0, 1, 3, 4]] > 1e-4).all()
    np.testing.assert_allclose(divergence.divergence(histograms, histograms), 0, atol=1e-12)


@pytest.mark.parametrize("measure", MEASURES)
def test_two_runs_are_bit_identical(measure):
    intensity, depth = frames(3)
    runs = []
    for _ in range(2):
        divergence = make_divergence(DivergenceConfig(measure=measure), CAMERA)
        histograms = divergence.histograms(intensity, depth)
        runs.append(divergence.divergence(histograms, histograms[0]))
    np.testing.assert_array_equal(*runs)


def test_result_does_not_depend_on_the_rest_of_the_batch():
    intensity, depth = frames(3)
    divergence = make_divergence(DivergenceConfig(), CAMERA)
    together = divergence.histograms(intensity, depth)
    alone = divergence.histograms(intensity[1:2], depth[1:2])
    np.testing.assert_allclose(together[1].normals, alone.normals, rtol=1e-5)
    np.testing.assert_array_equal(together[1].intensity, alone.intensity)


def test_earlier_histograms_survive_the_next_call():
    intensity, depth = frames(2)
    divergence = make_divergence(DivergenceConfig(), CAMERA)
    first = divergence.histograms(intensity[:1], depth[:1])
    kept = first.normals.copy(), first.intensity.copy()
    divergence.histograms(intensity[1:], depth[1:])
    np.testing.assert_array_equal(first.normals, kept[0])
    np.testing.assert_array_equal(first.intensity, kept[1])


def test_given_normals_count_as_computed_ones():
    intensity, depth = frames(2)
    divergence = make_divergence(DivergenceConfig(), CAMERA)
    computed = divergence.histograms(intensity, depth)
    given = divergence.histograms(intensity, depth, divergence.normals(depth))
    np.testing.assert_allclose(given.normals, computed.normals, atol=1e-4)


def test_windows_are_counted_apart():
    intensity, depth = frames(2)
    windows = (3, 4)
    config = DivergenceConfig(
        measure="windowed-kl", windows=windows, bins=256, smoothing=0.0, intensity_pixels="all"
    )
    histograms = make_divergence(config, CAMERA).histograms(intensity, depth)
    assert histograms.intensity.shape == (2, 12, 256)
    patch = intensity[1, 20:40, 60:80]  # row 1, column 3
    expected = np.bincount(patch.astype(int).ravel(), minlength=256) + 0.5
    np.testing.assert_allclose(histograms.intensity[1, 7], expected / expected.sum())


def test_windows_see_content_that_moved():
    intensity, depth = frames(1)
    depth[:] = 2
    mirrored = np.ascontiguousarray(intensity[:, :, ::-1] + 0)
    intensity[:, :, :40] = 20
    mirrored[:, :, :40], mirrored[:, :, 40:] = intensity[:, :, 40:], 20
    results = {}
    for measure in ("kl", "windowed-kl"):
        divergence = make_divergence(DivergenceConfig(measure=measure), CAMERA)
        pair = divergence.histograms(np.concatenate([intensity, mirrored]), np.repeat(depth, 2, 0))
        results[measure] = divergence.divergence(pair[0], pair[1])[0, 0]
    assert results["kl"] == pytest.approx(0, abs=1e-12)
    assert results["windowed-kl"] > 1


def test_intensity_can_be_restricted_to_pixels_with_depth():
    intensity, depth = frames(1)
    config = DivergenceConfig(intensity_pixels="with-depth", bins=256, smoothing=0.0)
    histogram = make_divergence(config, CAMERA).histograms(intensity, depth).intensity[0, 0]
    kept = intensity[0][depth[0] > 0].astype(int)
    expected = np.bincount(kept, minlength=256) + 0.5
    np.testing.assert_allclose(histogram, expected / expected.sum())


def test_earth_movers_in_one_dimension_equals_scipy():
    rng = np.random.default_rng(0)
    p, q = rng.dirichlet(np.ones(32), 5), rng.dirichlet(np.ones(32), 1)
    centres = (np.arange(32) + 0.5) / 32
    expected = [wasserstein_distance(centres, centres, row, q[0]) for row in p]
    np.testing.assert_allclose(earth_movers_1d(p, q), expected, rtol=1e-9)


def exact_transport(p, q, cost):
    size = len(p)
    rows = np.kron(np.eye(size), np.ones(size))
    columns = np.kron(np.ones(size), np.eye(size))
    result = linprog(cost.ravel(), A_eq=np.vstack([rows, columns]), b_eq=np.concatenate([p, q]))
    return result.fun


@pytest.mark.parametrize("inclinations", [4, 8])
def test_earth_movers_on_the_sphere_is_the_linear_program(inclinations):
    directions = bin_directions(inclinations)
    transport = SphereTransport(directions)
    normals = np.array([[0.0, 0, -1], [0.95, 0, -0.3], [0, -0.9, -0.43]])
    distributions = []
    for degrees in (0, 1, 5, 20):
        turned = normals @ so3_exp(np.deg2rad(degrees) * np.array([0.0, 1, 0])).T
        sums = bin_weights(turned, directions, np.deg2rad(60)).sum(axis=0) + 0.01
        distributions.append(sums / sums.sum())
    start, others = distributions[0], np.array(distributions[1:])
    exact = [exact_transport(p, start, transport.angles) for p in others]
    found = transport.distance(others, start[None])
    np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-9)
    assert (np.diff(found) > 0).all()
    assert transport.distance(start[None], start[None]) == 0


def test_earth_moved_between_two_bins_goes_their_angle():
    directions = bin_directions(4)
    transport = SphereTransport(directions)
    p, q = np.zeros((1, len(directions))), np.zeros((1, len(directions)))
    p[0, 0], q[0, 3] = 1.0, 1.0
    angle = np.arccos(directions[0] @ directions[3])
    assert transport.distance(p, q) == pytest.approx(angle)
    assert transport.distance(0.5 * (p + q), q) == pytest.approx(0.5 * angle)


def test_ms_parameters_are_the_maxima():
    assert ms_parameters([[0.1, 0.5], [0.3, 0.2]]) == (0.3, 0.5)


@pytest.mark.parametrize("bad", [[], [[1.0]], [[0.1, np.nan]], [[-0.1, 0.0]], [0.1, 0.2]])
def test_ms_parameters_refuse_bad_input(bad):
    with pytest.raises(InputError):
        ms_parameters(bad)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"measure": "chi"}, "earth-movers"),
        ({"bins": 1}, "bins"),
        ({"bins": 32.5}, "integer"),
        ({"alpha_deg": 0.0}, "alpha_deg"),
        ({"windows": (0, 2)}, "windows"),
        ({"windows": (2, 2, 2)}, "windows"),
        ({"intensity_pixels": "some"}, "with-depth"),
        ({"bin": 3}, "bins"),
    ],
)
def test_bad_options_are_refused(options, match):
    with pytest.raises(InputError, match=match):
        from_dict(DivergenceConfig, options)


def test_sizes_that_do_not_fit_are_refused():
    intensity, depth = frames(2)
    divergence = make_divergence(DivergenceConfig(), CAMERA)
    with pytest.raises(InputError, match="79x60"):
        divergence.histograms(intensity[:, :, 1:], depth[:, :, 1:])
    with pytest.raises(InputError, match="differ"):
        divergence.histograms(intensity[:1], depth)
    with pytest.raises(InputError, match="batch"):
        divergence.histograms(intensity[0], depth[0])
    for bad in (np.nan, np.inf, -1.0):
        with pytest.raises(InputError, match="depth holds"):
            divergence.histograms(intensity, np.where(depth == depth.max(), bad, depth))
    with pytest.raises(InputError, match="normals"):
        divergence.histograms(intensity, depth, np.zeros((1, 60, 80, 3)))


def test_images_on_the_device_need_not_be_contiguous():
    images = frames(2)
    divergence = make_divergence(DivergenceConfig(intensity_pixels="with-depth"), CAMERA)
    expected = divergence.histograms(*images)
    wide = [wp.array(np.repeat(image, 2, axis=2), dtype=wp.float32) for image in images]
    strided = [image[:, :, ::2] for image in wide]
    assert not strided[0].is_contiguous
    found = divergence.histograms(*strided)
    np.testing.assert_array_equal(found.intensity, expected.intensity)
    np.testing.assert_array_equal(found.normals, expected.normals)


def test_paper_preset():
    paper = DivergenceConfig.paper()
    assert (paper.measure, paper.bins, paper.smoothing) == ("kl", 256, 0.0)


def test_histograms_of_one_frame_can_be_picked():
    histograms = Histograms(np.arange(6.0).reshape(3, 1, 2), np.arange(3.0).reshape(3, 1, 1))
    assert histograms[-1].intensity.tolist() == [[[4.0, 5.0]]]
    assert histograms[0].normals.tolist() == [[[0.0]]]
