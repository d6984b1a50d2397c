"""A rolling shutter undone: against frames of a global one, a slow version, and the true path."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, se3_exp
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.sequences import RollingShutter, render_sequence
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.surfel.rolling_shutter import Shutter

CAMERA = xtion("160x120")
READOUT_S, INTERVAL_S = 0.03, 1 / 30
TWIST = np.array([0.02, -0.01, 0.015, 0.01, 0.02, -0.015])  # a frame: 2.7 cm, 1.5 degrees
START = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])
COUNT = 30
SHOWN = 10


def _even_path() -> np.ndarray:
    poses = [START]
    for k in range(COUNT - 1):
        poses.append(poses[-1] @ se3_exp(TWIST * np.cos(k / 8)))
    return np.stack(poses)


def _frames(scene: BoxScene, noise: str, *perturbations: RollingShutter) -> list[RGBDFrame]:
    times = INTERVAL_S * np.arange(COUNT)
    sequence = render_sequence(
        scene, _even_path(), CAMERA, noise, 3, perturbations=perturbations, timestamps=times
    )
    return list(sequence.frames)


@pytest.fixture(scope="module")
def rolling(box_scene: BoxScene) -> list[RGBDFrame]:
    return _frames(box_scene, "kinect", RollingShutter(READOUT_S))


@pytest.fixture(scope="module")
def clean(box_scene: BoxScene) -> RGBDFrame:
    return _frames(box_scene, "none", RollingShutter(READOUT_S))[SHOWN]


def _levelled(frame: RGBDFrame, motion: np.ndarray, interval_s: float = INTERVAL_S) -> Images:
    shutter = Shutter(1, READOUT_S, "cpu")
    shutter.use(CAMERA)
    for time in (0.0, interval_s):
        shutter.take_time([time])
    return shutter.level(Images(frame.color[None], frame.depth[None]), motion[None])


def test_levelled_frames_are_those_of_a_global_shutter(clean, box_scene):
    true = _frames(box_scene, "none")[SHOWN]
    levelled = _levelled(clean, se3_exp(TWIST * np.cos((SHOWN - 0.5) / 8)))
    known = (levelled.depth[0] > 0) & (true.depth > 0) & (clean.depth > 0)
    assert known.mean() > 0.9

    def errors(depth: np.ndarray, color: np.ndarray) -> np.ndarray:
        apart = np.abs(depth - true.depth)[known], np.abs(color.astype(float) - true.color)[known]
        return np.array([np.median(apart[0]), np.mean(apart[0]), np.mean(apart[1])])

    before, after = (
        errors(depth, color)
        for depth, color in ((clean.depth, clean.color), (levelled.depth[0], levelled.color[0]))
    )
    assert (after < np.array([0.25, 0.4, 0.6]) * before).all(), after / before


def test_points_go_where_their_rows_were(clean):
    """The levelled depth image is the one that the moved points of all pixels make."""
    frame, motion = clean, se3_exp(TWIST)
    levelled = _levelled(frame, motion).depth[0]
    height, width = CAMERA.shape
    share = (np.arange(height) + 0.5) / height - 0.5
    moves = np.stack([se3_exp(s * READOUT_S / INTERVAL_S * TWIST) for s in share])
    points = frame.depth[..., None] * CAMERA.rays()
    moved = np.einsum("vij,vuj->vui", moves[:, :3, :3], points) + moves[:, None, :3, 3]
    seen = frame.depth > 0
    u = np.rint(CAMERA.fx * moved[seen][:, 0] / moved[seen][:, 2] + CAMERA.cx).astype(int)
    v = np.rint(CAMERA.fy * moved[seen][:, 1] / moved[seen][:, 2] + CAMERA.cy).astype(int)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    there = levelled[v[inside], u[inside]]
    gap = np.abs(there - moved[seen][inside][:, 2])[there > 0]
    assert (there > 0).mean() > 0.95
    assert np.median(gap) < 0.003  # half a pixel on a slope
    assert np.quantile(gap, 0.9) < 0.02


@pytest.mark.parametrize("interval_s", [0.0, -0.1, np.nan])
def test_frames_without_a_known_motion_stay(rolling, interval_s):
    for motion, interval in ((se3_exp(TWIST), interval_s), (np.eye(4), INTERVAL_S)):
        levelled = _levelled(rolling[SHOWN], motion, interval)
        np.testing.assert_array_equal(levelled.color[0], rolling[SHOWN].color)
        np.testing.assert_allclose(levelled.depth[0], rolling[SHOWN].depth, rtol=1e-6)


def _tracked(frames: list[RGBDFrame], **options: float) -> np.ndarray:
    # The mask takes what the first frames, not yet levelled, bend in this scene for motion.
    rules = {"max_surfels": 60_000, "motion_mask": "none"}
    system = slam.make("surfel", CAMERA, **rules, **options)
    system.reset(START)
    return np.stack([system.track(frame).T_world_camera for frame in frames])


def test_the_path_is_that_of_a_global_shutter(rolling, box_scene):
    truth = _even_path()
    bent, level = (_tracked(rolling, readout_s=t) for t in (0.0, READOUT_S))
    even = _tracked(_frames(box_scene, "kinect"))
    errors = [ate_rmse(path, truth, align="none") for path in (bent, level, even)]
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < errors[2] + 0.0015


def test_a_state_goes_on_bit_exactly_and_known_poses_level_too(rolling):
    one, other = (
        slam.make("surfel", CAMERA, max_surfels=60_000, readout_s=READOUT_S) for _ in range(2)
    )
    one.reset(START)
    for frame in rolling[:4]:
        one.track(frame)
    other.set_state(one.get_state())
    for frame in rolling[4:7]:
        np.testing.assert_array_equal(
            one.track(frame).T_world_camera, other.track(frame).T_world_camera
        )
    for system in (one, other):
        system.fuse(rolling[7], _even_path()[7])
    np.testing.assert_array_equal(one.surface_points(), other.surface_points())
    plain = slam.make("surfel", CAMERA, max_surfels=60_000)
    with pytest.raises(InputError, match="lacks times"):
        other.set_state(plain.get_state())


def test_a_wrong_size_is_refused(rolling):
    system = slam.make("surfel", CAMERA, readout_s=READOUT_S)
    system.reset()
    with pytest.raises(InputError):
        system.track(RGBDFrame(rolling[0].color[:60], rolling[0].depth[:60]))
