"""Fixtures shared by all tests."""

import pytest
from box_scene import BoxScene
from hypothesis import settings

# The same examples on every run: a failure says something about the change that shows it.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def box_scene() -> BoxScene:
    """A small textured room with two boxes, seed 0."""
    return BoxScene(seed=0)
