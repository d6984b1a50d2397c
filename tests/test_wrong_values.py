"""Values of another type or shape at the public functions: one line, and no other exception."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ms_slam_env import camera, divergence, metrics, slam
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image, xtion
from ms_slam_env.errors import InputError

K = xtion("80x60")
COLOR = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
DEPTH = np.full((60, 80), 1.5, np.float32)
FRAME = RGBDFrame(COLOR, DEPTH)
POSES = np.stack([np.eye(4)] * 4)
POSES[:, 0, 3] = np.arange(4) * 0.1
NOTHING = (None, "x", object(), {}, [[1, 2], [3]], np.array(["a"]))
WRONG = (*NOTHING, [], -1, 10**400, np.nan, np.zeros((2, 3)), np.zeros((60, 80), complex))


@pytest.fixture(scope="module")
def backend() -> slam.SlamBackend:
    made = slam.make("surfel", K, max_surfels=60_000)
    made.reset()
    made.track(FRAME)
    return made


def _refused(call: Callable[[Any], object], *values: Any) -> None:
    for value in values:
        with pytest.raises(InputError) as caught:
            call(value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy", "width", "height"])
def test_intrinsics_are_numbers_and_sizes_whole(name: str) -> None:
    own = {key: getattr(K, key) for key in ("fx", "fy", "cx", "cy", "width", "height")}
    _refused(lambda value: Intrinsics(**{**own, name: value}), *NOTHING, True, np.nan, 10**400)
    if name in ("width", "height"):
        _refused(lambda value: Intrinsics(**{**own, name: value}), 80.5, 80.0, 0)
    assert Intrinsics(**{**own, name: np.int64(own[name])})


def test_frames_and_images_are_arrays() -> None:
    _refused(lambda value: RGBDFrame(value, DEPTH), *WRONG)
    _refused(lambda value: RGBDFrame(COLOR, value), *WRONG)
    _refused(lambda value: RGBDFrame(COLOR, DEPTH, value), *NOTHING)
    _refused(intensity_image, *WRONG)
    _refused(lambda value: camera.check_frame(value, K), *WRONG, COLOR)


def test_divergences_name_what_is_no_image_or_camera() -> None:
    grey = intensity_image(COLOR)
    _refused(lambda value: divergence.intensity_divergence(value, grey), *WRONG)
    _refused(lambda value: divergence.depth_divergence(DEPTH, value, K), *WRONG)
    _refused(lambda value: divergence.depth_divergence(DEPTH, DEPTH, value), *NOTHING, 80)
    _refused(divergence.ms_parameters, *WRONG)
    config = divergence.DivergenceConfig()
    _refused(lambda value: divergence.make_divergence(config, value), *NOTHING)
    _refused(lambda value: divergence.make_divergence(value, K), *NOTHING)


def test_backends_name_what_is_no_frame_pose_or_scale(backend: slam.SlamBackend) -> None:
    before = backend.frames_counted
    _refused(lambda value: slam.make("surfel", value), *NOTHING, 80)
    _refused(backend.track, *WRONG, COLOR)
    _refused(lambda value: backend.fuse(value, np.eye(4)), *WRONG)
    _refused(lambda value: backend.track(FRAME, value), *WRONG[1:])
    _refused(backend.reset, *WRONG[1:])
    _refused(backend.predict, *WRONG, np.full((1, 4, 4), np.nan))
    _refused(lambda value: backend.predict(np.eye(4)[None], value), *NOTHING, 0, 1.5, np.nan)
    assert backend.frames_counted == before


@pytest.mark.parametrize("name", ["ate_rmse", "rpe_rmse", "path_length", "drifts"])
def test_errors_of_trajectories_name_what_is_none(name: str) -> None:
    measure = getattr(metrics, name)
    rest = () if name == "path_length" else (POSES,)
    positions = WRONG[-2]
    wrong = WRONG if name == "drifts" else [one for one in WRONG if one is not positions]
    _refused(lambda value: measure(value, *rest), *wrong)
    if rest:
        _refused(lambda value: measure(POSES, value), *wrong)


def test_times_of_robots_and_frames_are_numbers() -> None:
    _refused(lambda value: metrics.task_time([value]), *WRONG)
    flags = np.ones(3, bool)
    _refused(lambda value: metrics.relocalisation(value, flags, flags), *WRONG)
