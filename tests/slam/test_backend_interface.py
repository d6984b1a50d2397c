"""What every SLAM backend must do, on a rendered room."""

from __future__ import annotations

import pickle
import re

import numpy as np
import pytest
from arc import CAMERA, START, arc, black_frame
from box_scene import BoxScene
from scipy.spatial import cKDTree

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, intensity_image
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose, relative_angle, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.frame_selection import make_config

COUNT = 12
MANAGED = "surfel behind a filter"
"""A decorator is a backend, too; of the path it processes some of the frames."""
FILTER = {"name": "divergence", "threshold": 0.003}
OPTIONS: dict[str, dict[str, float]] = {
    "surfel": {"max_surfels": 60_000, "depth_cutoff_m": 4.0},
    "odometry": {"max_surfels": 60_000},
    "sparse": {"max_surfels": 60_000},
}
OPTIONS[MANAGED] = OPTIONS["surfel"]
ACCURACY_M = {
    "surfel": 0.008,
    "odometry": 0.02,
    "volumetric": 0.015,
    "kinectfusion": 0.015,
    "sparse": 0.01,
    MANAGED: 0.022,  # two frames are dropped before any motion is known
}
"""Largest error of position on the noisy path of 0.11 m."""


REFUSED_FOR = {
    **dict.fromkeys(("surfel", MANAGED), "points 0, at least 100"),
    "volumetric": r"inliers 0\.[0-5]\d*, at least 0\.6",
}
"""Pattern of what refuses a frame from elsewhere; the others find no motion to judge."""

SLIDES_M = {"kinectfusion": 0.04}
"""What is granted besides where geometry says little: its alignment is of geometry alone."""


PATH = arc(COUNT)


def _make(name: str, **options: object) -> slam.SlamBackend:
    backend = slam.make("surfel" if name == MANAGED else name, CAMERA, **options)
    return make_config(**FILTER).manage(backend) if name == MANAGED else backend


def _new(name: str) -> slam.SlamBackend:
    backend = _make(name, **OPTIONS.get(name, {}))
    backend.reset(START)
    return backend


def _capture(scene: BoxScene, pose: np.ndarray, noise: str = "kinect") -> RGBDFrame:
    return RGBDSensor(scene, CAMERA, noise=noise, seed=1).capture(pose, 0)


@pytest.fixture(scope="module")
def frames(arc_frames: list[RGBDFrame]) -> list[RGBDFrame]:
    return arc_frames[:COUNT]


@pytest.fixture(scope="module", params=[*sorted(slam.BACKENDS), MANAGED])
def name(request: pytest.FixtureRequest) -> str:
    if request.param in ("volumetric", "kinectfusion"):
        pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)
    if request.param == "sparse":
        pytest.importorskip("gtsam", reason="GTSAM is not installed", exc_type=ImportError)
    return str(request.param)


@pytest.fixture(scope="module")
def tracked(name, frames) -> tuple[slam.SlamBackend, list[slam.TrackResult]]:
    """A backend that has tracked the path, and what it said; tests only look at it."""
    backend = _new(name)
    return backend, [backend.track(frame) for frame in frames]


def _errors_m(results: list[slam.TrackResult]) -> np.ndarray:
    estimates = np.stack([result.T_world_camera for result in results])
    return np.linalg.norm(estimates[:, :3, 3] - PATH[: len(results), :3, 3], axis=1)


def test_a_noisy_path_is_tracked(name, tracked):
    _, results = tracked
    np.testing.assert_array_equal(results[0].T_world_camera, START)
    for result, truth in zip(results, PATH, strict=True):
        assert result.tracking_ok
        assert not result.relocalised
        assert not result.reason
        assert relative_angle(result.T_world_camera[:3, :3], truth[:3, :3]) < np.radians(1.0)
        np.testing.assert_allclose(
            result.T_world_camera[:3, :3] @ result.T_world_camera[:3, :3].T, np.eye(3), atol=1e-6
        )
        assert 0.8 < result.inlier_fraction <= 1
    assert 0 < results[-1].residual_m < 0.03
    assert all(result.processed for result in results) == (name != MANAGED)
    assert _errors_m(results).max() < ACCURACY_M[name]


def test_views_resemble_the_scene(tracked, box_scene):
    backend, results = tracked
    pose = results[6].T_world_camera
    views = backend.predict(np.stack([pose, PATH[0]]), scale=0.5)
    half = CAMERA.scaled(0.5)
    assert views.intrinsics == half
    assert views.depth.shape == views.intensity.shape == (2, *half.shape)
    assert views.normals.shape == (2, *half.shape, 3)
    assert {views.depth.dtype, views.intensity.dtype, views.normals.dtype} == {np.dtype("float32")}
    truth = RGBDSensor(box_scene, half, noise="none", seed=0).capture(PATH[6], 0)
    near = (truth.depth > 0) & (truth.depth < 3.5)
    both = near & (views.depth[0] > 0)
    assert both.sum() > 0.85 * near.sum()
    assert np.median(np.abs(views.depth[0] - truth.depth)[both]) < 0.015
    grey = intensity_image(truth.color)
    assert np.median(np.abs(views.intensity[0] - grey)[both]) < 6
    filled = views.depth[0] > 0
    normals, rays = views.normals[0][filled], half.rays()[filled]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-3)
    assert np.mean((normals * rays).sum(-1) < 0) > 0.97
    for image in (views.depth, views.intensity, views.normals):
        assert not image[views.depth == 0].any()


def test_the_surface_is_that_of_the_scene(tracked, box_scene):
    backend, _ = tracked
    points, attributes = backend.surface_points(), backend.map_attributes()
    assert len(points) > 1000
    assert points.dtype == np.float64
    colors = backend.surface_colors()
    assert colors.shape == points.shape
    assert colors.dtype == np.uint8
    np.testing.assert_array_equal(attributes["color"], colors)
    assert {len(values) for values in attributes.values()} == {len(points)}
    assert len(backend.map_points()) >= len(points)
    truth, _ = box_scene.surface_points(0.02)
    distance, _ = cKDTree(truth).query(points)
    assert np.median(distance) < 0.015


def test_frames_at_known_poses_make_a_map_to_track_against(name, frames, box_scene):
    backend = _new(name)
    for frame, pose in zip(frames[:6], PATH, strict=False):
        result = backend.fuse(frame, pose)
        assert result.tracking_ok
        np.testing.assert_array_equal(result.T_world_camera, pose)
    truth = _capture(box_scene, PATH[5], noise="none")
    depth = backend.predict(PATH[5:6]).depth[0]
    both = (truth.depth < 3.5) & (depth > 0)
    assert np.median(np.abs(depth - truth.depth)[both]) < 0.012
    result = backend.track(frames[6])
    assert result.tracking_ok
    assert np.linalg.norm(result.T_world_camera[:3, 3] - PATH[6, :3, 3]) < 0.012


def _is_plain(value: object) -> bool:
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(item) for key, item in value.items())
    if isinstance(value, list):
        return all(_is_plain(item) for item in value)
    return value is None or isinstance(value, (np.ndarray, int, float, str, bool))


def test_a_state_goes_on_bit_exactly(name, frames):
    backend = _new(name)
    for frame in frames[:4]:
        backend.track(frame)
    backend.track(black_frame())  # saved while lost
    state = backend.get_state()
    assert _is_plain(state)
    saved = pickle.dumps(state)
    expected = [backend.track(frame) for frame in frames[4:7]]
    for other in (backend, _new(name)):
        other.set_state(pickle.loads(saved))
        for frame, result in zip(frames[4:7], expected, strict=True):
            again = other.track(frame)
            np.testing.assert_array_equal(again.T_world_camera, result.T_world_camera)
            assert again.tracking_ok == result.tracking_ok
            assert again.relocalised == result.relocalised
            assert again.residual_m == result.residual_m
        np.testing.assert_array_equal(other.surface_points(), backend.surface_points())
        np.testing.assert_array_equal(other.surface_colors(), backend.surface_colors())
        views, theirs = other.predict(PATH[:2]), backend.predict(PATH[:2])
        np.testing.assert_array_equal(views.depth, theirs.depth)
        np.testing.assert_array_equal(views.intensity, theirs.intensity)


def test_reset_forgets_everything(name, frames, tracked):
    backend = _new(name)
    backend.track(frames[8])
    backend.track(black_frame())
    backend.reset(START)
    assert len(backend.surface_points()) == 0
    assert not backend.predict(START[None]).depth.any()
    for frame, before in zip(frames[:4], tracked[1], strict=False):
        again = backend.track(frame)
        np.testing.assert_array_equal(again.T_world_camera, before.T_world_camera)


def test_empty_frames_are_lost_and_leave_pose_and_map(name, frames):
    backend = _new(name)
    result = backend.track(black_frame())
    assert not result.tracking_ok
    assert "first frame" in result.reason
    for frame in frames[:3]:
        held = backend.track(frame)
    points = backend.surface_points()
    rng = np.random.default_rng(0)
    garbage = RGBDFrame(
        rng.integers(0, 256, (*CAMERA.shape, 3), dtype=np.uint8),
        rng.uniform(0.5, 3, CAMERA.shape).astype(np.float32),
    )
    for bad in (black_frame(), garbage):
        result = backend.track(bad)
        assert not result.tracking_ok
        assert result.reason
        np.testing.assert_array_equal(result.T_world_camera, held.T_world_camera)
    np.testing.assert_array_equal(backend.surface_points(), points)
    result = backend.track(frames[4])
    assert result.tracking_ok
    assert result.relocalised
    assert np.linalg.norm(result.T_world_camera[:3, 3] - PATH[4, :3, 3]) < ACCURACY_M[name]
    assert not backend.track(frames[5]).relocalised


def test_a_frame_from_elsewhere_is_not_called_tracked(name, frames, box_scene):
    backend = _new(name)
    for frame in frames[:3]:
        backend.track(frame)
    elsewhere = _capture(box_scene, look_at([-0.5, 0.5, 1.2], [-1.5, -1.5, 0.6]))
    result = backend.track(elsewhere)
    assert not result.tracking_ok
    assert re.fullmatch(REFUSED_FOR.get(name, ""), result.refusal)


def test_a_guess_finds_a_distant_pose(name, frames, box_scene):
    backend = _new(name)
    for frame in frames[:3]:
        backend.track(frame)
    jump = PATH[2] @ make_pose(so3_exp(np.radians([3, 20, 0])), [0.12, 0.0, 0.0])
    guess = jump @ make_pose(so3_exp([0.0, 0.01, 0.0]), [0.01, 0.0, 0.0])
    result = backend.track(_capture(box_scene, jump), guess)
    assert result.tracking_ok, result.reason
    error_m = np.linalg.norm(result.T_world_camera[:3, 3] - jump[:3, 3])
    assert error_m < 0.03 + SLIDES_M.get(name, 0.0)


def test_a_step_of_the_environment_is_tracked(name, frames, box_scene):
    backend = _new(name)
    for frame in frames[:3]:
        backend.track(frame)
    step = make_pose(so3_exp(np.radians([0, -12, 0])), [0.12, 0.0, 0.0])
    result = backend.track(_capture(box_scene, PATH[2] @ step))
    assert result.tracking_ok, result.reason
    assert np.linalg.norm(result.T_world_camera[:3, 3] - (PATH[2] @ step)[:3, 3]) < 0.03


def test_bad_input_is_refused(name):
    backend = _new(name)
    small = RGBDFrame(np.zeros((60, 80, 3), dtype=np.uint8), np.zeros((60, 80), dtype=np.float32))
    no_pose = np.full((4, 4), np.nan)
    with pytest.raises(InputError, match="80x60"):
        backend.track(small)
    with pytest.raises(InputError, match="80x60"):
        backend.fuse(small, START)
    with pytest.raises(InputError, match="T_world_camera_guess"):
        backend.track(black_frame(), no_pose)
    with pytest.raises(InputError, match="T_world_camera"):
        backend.fuse(black_frame(), no_pose)
    with pytest.raises(InputError, match="T_world_camera"):
        backend.reset(no_pose)
    with pytest.raises(InputError, match="poses"):
        backend.predict(START)
    for scale in (0.0, 2.0, np.nan):
        with pytest.raises(InputError, match="scale"):
            backend.predict(START[None], scale=scale)
    with pytest.raises(InputError, match=r"valid choices: .*depth_cutoff_m"):
        _make(name, depth_cutof_m=3.0)
    with pytest.raises(InputError, match="depth_cutoff_m"):
        _make(name, depth_cutoff_m=-1.0)


def _first_allowed(env: ActiveSlamEnv) -> int:
    return int(np.flatnonzero(env.action_masks())[0])


def test_works_in_the_environment(name):
    env = ActiveSlamEnv(
        "free",
        scene="wall",
        scene_seed=0,
        slam="surfel" if name == MANAGED else name,
        frame_management=FILTER if name == MANAGED else "none",
        step_m=0.04,
        step_rad=0.04,
        image_size="80x60",
    )
    env.reset(seed=0)
    env.step(_first_allowed(env))
    saved = env.save_state()
    runs = []
    for _ in range(2):
        env.load_state(saved)
        infos = [env.step(_first_allowed(env))[-1] for _ in range(2)]
        assert all(info["tracking_ok"] for info in infos)
        views = env.predict_candidates()
        assert views.depth.shape == (49, *views.intrinsics.shape)
        runs.append((env.episode.trajectory_estimate, views.depth, views.intensity))
    for first, second in zip(*runs, strict=True):
        np.testing.assert_array_equal(first, second)
    assert env.episode.pose_errors.max() < 0.03 + SLIDES_M.get(name, 0.0)
