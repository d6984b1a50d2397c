"""Point cloud odometry of other libraries, against the truth and against the libraries alone."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from arc import CAMERA, START, arc, black_frame

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, make_pose, relative_angle

COUNT = 8
PATH = arc(COUNT)
ACCURACY_M = {"small_gicp": 0.01, "kiss_icp": 0.12}
"""KISS-ICP, made for lidars, is off by nearly the whole path of 8 cm before these few walls."""


@pytest.fixture(scope="module")
def frames(arc_frames: list[RGBDFrame]) -> list[RGBDFrame]:
    return arc_frames[:COUNT]


def _make(name: str, **options: object) -> slam.SlamBackend:
    if name == "kiss_icp":
        pytest.importorskip("kiss_icp", reason="KISS-ICP is not installed")
    backend = slam.make(name, CAMERA, **options)
    backend.reset(START)
    return backend


def _track(backend: slam.SlamBackend, frames: list[RGBDFrame]) -> np.ndarray:
    return np.stack([backend.track(frame).T_world_camera for frame in frames])


@pytest.mark.parametrize("name", ACCURACY_M)
def test_a_noisy_path_is_tracked(name: str, frames: list[RGBDFrame]) -> None:
    backend = _make(name)
    poses = _track(backend, frames)
    np.testing.assert_array_equal(poses[0], START)
    assert np.linalg.norm(poses[:, :3, 3] - PATH[:, :3, 3], axis=1).max() < ACCURACY_M[name]
    assert relative_angle(poses[-1, :3, :3], PATH[-1, :3, :3]) < 0.4 * ACCURACY_M[name]
    depth = backend.predict(PATH[-1:]).depth[0]
    both = (depth > 0) & (frames[-1].depth > 0)
    assert both.mean() > 0.5
    assert np.median(np.abs(depth - frames[-1].depth)[both]) < 0.02
    assert len(backend.surface_points()) == len(backend.surface_colors()) > 1000
    backend.reset(START)
    np.testing.assert_array_equal(_track(backend, frames[:4]), poses[:4])


def test_kiss_icp_is_what_the_library_does(frames: list[RGBDFrame]) -> None:
    kiss = pytest.importorskip("kiss_icp.kiss_icp", reason="KISS-ICP is not installed")
    from kiss_icp.config import KISSConfig

    options = KISSConfig()
    options.data.deskew = False
    options.data.max_range = 4.0
    options.mapping.voxel_size = 0.08
    options.adaptive_threshold.initial_threshold = 0.2
    options.adaptive_threshold.min_motion_th = 0.02
    options.registration.max_num_threads = 1
    pipeline = kiss.KissICP(options)
    expected = []
    for frame in frames:
        rays = CAMERA.rays() * frame.depth[..., None].astype(float)
        cloud = rays[(frame.depth > 0) & (frame.depth <= 4.0)]
        pipeline.register_frame(cloud, np.zeros(0))
        expected.append(pipeline.last_pose)
    ours = dict(voxel_size_m=0.08, initial_threshold_m=0.2, min_motion_m=0.02)
    backend = _make("kiss_icp", **ours)
    backend.reset()
    found = _track(backend, frames)
    np.testing.assert_allclose(found, np.stack(expected), atol=1e-6)


def test_rounding_does_not_grow(frames: list[RGBDFrame]) -> None:
    backend = _make("small_gicp", downsampling_m=0.1)
    R = _track(backend, [frames[0]] * 60)[-1][:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_small_gicp_undoes_a_known_motion(frames: list[RGBDFrame]) -> None:
    """The same readings at another pose: what is found must be that pose."""
    backend = _make("small_gicp")
    backend.track(frames[0])
    backend.fuse(frames[0], START)
    guess = START @ make_pose(np.eye(3), [0.02, -0.01, 0.015])
    found = backend.track(frames[0], guess).T_world_camera
    np.testing.assert_allclose(invert(START) @ found, np.eye(4), atol=2e-3)


@pytest.mark.parametrize("name", ACCURACY_M)
def test_a_frame_without_depth_is_lost_and_changes_nothing(
    name: str, frames: list[RGBDFrame]
) -> None:
    backend = _make(name)
    assert not backend.track(black_frame()).tracking_ok
    held = _track(backend, frames[:3])[-1]
    points = backend.surface_points()
    result = backend.track(black_frame())
    assert not result.tracking_ok
    assert "too few depth readings" in result.reason
    np.testing.assert_array_equal(result.T_world_camera, held)
    np.testing.assert_array_equal(backend.surface_points(), points)
    again = backend.track(frames[3])
    assert again.relocalised
    assert np.linalg.norm(again.T_world_camera[:3, 3] - PATH[3, :3, 3]) < ACCURACY_M[name]


@pytest.mark.parametrize("name", ACCURACY_M)
def test_saving_is_refused_in_one_line(name: str, frames: list[RGBDFrame], tmp_path) -> None:
    backend = _make(name)
    backend.track(frames[0])
    with pytest.raises(InputError, match="cannot be saved"):
        backend.save(tmp_path / "map.npz")


def test_a_missing_library_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("kiss_icp", "kiss_icp.config", "kiss_icp.kiss_icp"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"ms-slam-env\[peers\]"):
        slam.make("kiss_icp", CAMERA)


def test_unknown_options_list_the_valid_ones() -> None:
    with pytest.raises(InputError, match=r"valid choices: .*correspondence_m"):
        slam.make("small_gicp", CAMERA, correspondance_m=0.1)
