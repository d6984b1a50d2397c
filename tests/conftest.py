"""Fixtures shared by all tests."""

import pytest
from box_scene import BoxScene


@pytest.fixture(scope="session")
def box_scene() -> BoxScene:
    """A small textured room with two boxes, seed 0."""
    return BoxScene(seed=0)
