"""Fixtures shared by all tests."""

from collections.abc import Iterator

import pytest
from box_scene import BoxScene
from hypothesis import settings

# The same examples on every run: a failure says something about the change that shows it.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")


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
