"""Fixtures shared by all tests."""

import same_kernels  # noqa: F401  # before NumPy

# isort: split
import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from arc import CAMERA, arc
from box_scene import BoxScene
from hypothesis import settings

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.sensor import RGBDSensor

# The same examples on every run: a failure says something about the change that shows it.
settings.register_profile("repeatable", derandomize=True, deadline=None)  # no timed tests
settings.load_profile("repeatable")


ROOT = Path(__file__).resolve().parents[1]


def pytest_configure() -> None:
    """Refuse to test another checkout than this one, as an environment that two share would."""
    for name in ("ms_slam_env", "ms_slam_agents", "ms_slam_baselines"):
        found = Path(next(iter(importlib.import_module(name).__path__))).resolve()
        if ROOT not in found.parents:
            raise pytest.UsageError(
                f"{name} would be tested from {found}, these tests are of {ROOT}: install this "
                "checkout (make install), or put it on PYTHONPATH under these three names"
            )


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests leave the user's cache alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MS_SLAM_ENV_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def box_scene() -> BoxScene:
    """A small textured room with two boxes, seed 0."""
    return BoxScene(seed=0)


@pytest.fixture(scope="session")
def arc_frames(box_scene: BoxScene) -> list[RGBDFrame]:
    """Sixteen noisy frames along `arc` in that room."""
    sensor = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=0)
    return [sensor.capture(pose, index) for index, pose in enumerate(arc(16))]
