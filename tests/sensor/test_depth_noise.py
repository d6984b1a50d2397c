"""Depth noise against the published formulas."""

from dataclasses import replace

import numpy as np
import pytest
from box_scene import BoxScene
from test_shading import FRONT, Wall

from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose
from ms_slam_env.sensor import NoiseConfig, NoNoise, RGBDSensor

K = xtion("160x120")
FB = 570.3 * 0.075  # focal length at 640 pixels times baseline
GREY = np.full((4, 4, 3), 128, np.uint8)
LIGHT = np.ones((4, 3))


def wall_sensor(noise: NoiseConfig, size_m: float = 400.0, seed: int = 0) -> RGBDSensor:
    return RGBDSensor(Wall(GREY, LIGHT, size_m), K, noise=noise, seed=seed)


def at_distance(z: float) -> np.ndarray:
    return make_pose(FRONT[:3, :3], [1.0 - z, 0.0, 0.0])


def at_angle(z: float, degrees: float) -> np.ndarray:
    """Pose whose optical axis meets the wall x = 1 at ``z`` metres and at an incidence angle."""
    a = np.radians(degrees)
    direction = np.array([np.cos(a), np.sin(a), 0.0])
    target = np.array([1.0, 0.0, 0.0])
    return look_at(target - z * direction, target)


@pytest.mark.parametrize("size", ["80x60", "160x120", "320x240"])
@pytest.mark.parametrize("z", [0.7, 1.63, 3.1])
def test_quantisation_is_an_eighth_of_a_native_pixel(size: str, z: float) -> None:
    noise = replace(NoNoise(), disparity_step_px=0.125)
    sensor = RGBDSensor(Wall(GREY, LIGHT), xtion(size), noise=noise)
    depth = sensor.capture(at_distance(z), 0).depth
    expected = FB / (np.round(FB / z / 0.125) * 0.125)
    np.testing.assert_allclose(depth[depth > 0], expected, rtol=1e-5)


def test_every_reading_lies_on_a_step(box_scene: BoxScene) -> None:
    sensor = RGBDSensor(box_scene, K, noise="kinect")
    depth = sensor.capture(box_scene.sample_start(np.random.default_rng(0)), 0).depth
    steps = FB / depth[depth > 0].astype(np.float64) / 0.125
    assert np.abs(steps - np.round(steps)).max() < 1e-3


@pytest.mark.parametrize("z", [0.6, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("quantised", [False, True])
def test_axial_noise_is_that_of_nguyen(z: float, quantised: bool) -> None:
    step = 0.125 if quantised else 0.0
    sensor = wall_sensor(replace(NoNoise(), axial=1.0, disparity_step_px=step))
    depths = [sensor.capture(at_distance(z), index).depth[30:90, 40:120] for index in range(5)]
    sigma = sensor.noise.depth_sigma_m(z)
    assert sigma == pytest.approx(0.0012 + 0.0019 * (z - 0.4) ** 2)
    # About one fixed depth the steps do not average out, hence the wider margin.
    assert np.std(depths) == pytest.approx(sigma, rel=0.15 if quantised else 0.02)
    assert np.mean(depths) == pytest.approx(z, abs=0.1 * sigma if not quantised else sigma)


def test_axial_noise_grows_at_steep_angles() -> None:
    noise = replace(NoNoise(), axial=1.0)
    sensor, ideal = wall_sensor(noise), wall_sensor(NoNoise())
    T = at_angle(1.0, 75.0)
    truth = ideal.ground_truth(T).depth[58:62, 78:82]
    errors = [sensor.capture(T, i).depth[58:62, 78:82] - truth for i in range(300)]
    a = np.radians(75.0)
    sigma = 0.0012 + 0.0019 * 0.36 + 0.0001 * (a / (np.pi / 2 - a)) ** 2
    assert np.std(errors) == pytest.approx(sigma, rel=0.06)


def test_lateral_jitter_moves_the_sample_by_0_8_native_pixels() -> None:
    sensor, ideal = wall_sensor(replace(NoNoise(), lateral=1.0)), wall_sensor(NoNoise())
    T = at_angle(2.0, 50.0)
    centre = np.s_[50:70, 70:90]
    truth = ideal.ground_truth(T).depth
    slope = np.gradient(truth, axis=1)[centre]  # depth per pixel; the wall leans in x only
    shifts = [(sensor.capture(T, i).depth - truth)[centre] / slope for i in range(40)]
    a = np.radians(50.0)
    expected = (0.8 + 0.035 * a / (np.pi / 2 - a)) * 160 / 640
    assert np.std(shifts) == pytest.approx(expected, rel=0.05)


def test_readings_drop_out_at_grazing_angles() -> None:
    noise = replace(NoNoise(), grazing_start_deg=70.0, grazing_end_deg=80.0)
    sensor = wall_sensor(noise)

    def valid(degrees: float) -> float:
        frames = [sensor.capture(at_angle(2.0, degrees), i).depth[59:61, 79:81] for i in range(50)]
        return float(np.mean(np.array(frames) > 0))

    assert valid(60.0) == 1.0
    assert valid(75.0) == pytest.approx(0.5, abs=0.12)
    assert valid(84.0) == 0.0


def test_range_limits() -> None:
    noise = replace(NoNoise(), min_range_m=0.5, max_range_m=4.0)
    sensor = wall_sensor(noise)
    valid = [bool(sensor.capture(at_distance(z), 0).depth.any()) for z in (0.45, 0.55, 3.9, 4.1)]
    assert valid == [False, True, True, False]


def test_projector_shadow_is_as_wide_as_the_disparity_jump(box_scene: BoxScene) -> None:
    """Left of a near box the far wall is dark for the difference of the two disparities."""
    sensor = RGBDSensor(box_scene, xtion("640x480"), noise=replace(NoNoise(), shadow=1.0))
    T = look_at([-0.4, 0.0, 0.6], [2.0, 0.0, 0.6])  # box_0's face at x = 0.9, wall at x = 2
    row = sensor.capture(T, 0).depth[240]
    truth = sensor.ground_truth(T)
    labels = truth.labels[240]
    left = int(np.flatnonzero(labels == 1)[0])
    dark = np.flatnonzero(row == 0)
    expected = FB / 1.3 - FB / 2.4
    assert dark.max() == left - 1
    assert len(dark) == pytest.approx(expected, abs=1.5)


def test_edges_drop_out_with_the_configured_probability(box_scene: BoxScene) -> None:
    T = look_at([-0.4, 0.0, 0.6], [2.0, 0.0, 0.6])
    for probability in (0.3, 1.0):
        sensor = RGBDSensor(box_scene, K, noise=replace(NoNoise(), edge_dropout=probability))
        labels = sensor.ground_truth(T).labels
        beside = (labels[40:60, 1:-1] == 1) & (labels[40:60, :-2] == 0)
        missing = [(sensor.capture(T, i).depth[40:60, 1:-1] == 0)[beside].mean() for i in range(20)]
        assert np.mean(missing) == pytest.approx(probability, abs=0.08)
        flat = np.s_[62:68, 75:85]  # on the face of the box
        assert (sensor.capture(T, 0).depth[flat] > 0).all()


def test_no_noise_is_the_truth(box_scene: BoxScene) -> None:
    sensor = RGBDSensor(box_scene, K, noise="none", seed=5)
    T = box_scene.sample_start(np.random.default_rng(1))
    frame, truth = sensor.capture(T, 7), sensor.ground_truth(T)
    assert np.array_equal(frame.depth, truth.depth)
    assert np.array_equal(frame.color, truth.color)


def test_zero_strengths_are_no_noise(box_scene: BoxScene) -> None:
    values = {name: getattr(NoNoise(), name) for name in NoiseConfig.__dataclass_fields__}
    T = box_scene.sample_start(np.random.default_rng(1))
    zero = RGBDSensor(box_scene, K, noise=NoiseConfig(**values)).capture(T, 0)
    none = RGBDSensor(box_scene, K, noise="none").capture(T, 0)
    assert np.array_equal(zero.depth, none.depth)
    assert np.array_equal(zero.color, none.color)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("axial", -1.0, "axial"),
        ("read", float("nan"), "read"),
        ("baseline_m", 0.0, "baseline_m"),
        ("edge_dropout", 1.5, "edge_dropout"),
        ("max_range_m", 0.3, "max_range_m"),
        ("grazing_end_deg", 10.0, "grazing_end_deg"),
    ],
)
def test_bad_strengths_are_refused(field: str, value: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(NoiseConfig(), **{field: value})
