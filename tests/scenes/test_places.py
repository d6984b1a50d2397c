"""Words for places that are not free."""

import numpy as np
import pytest

from ms_slam_env.scenes.base import enclosed, floor_height, outside
from ms_slam_env.sensor.scene_cache import get_scene


@pytest.mark.parametrize(
    ("position", "words"),
    [
        ((0.0, -1.0, 1.0), ""),
        ((1.25, 0.05, 0.4), "inside something in scene box"),
        ((0.0, 0.0, -0.5), "below the floor of scene box, which is at z = 0.00 m"),
        ((0.0, 0.0, 3.0), "outside scene box, which spans -2.00 to 2.00 x -2.00 to 2.00 x 0.00 to"),
        ((9.0, 0.0, -3.0), "outside scene box, which spans"),
    ],
)
def test_where_a_place_lies(box_scene, position, words):
    found = enclosed(box_scene, np.array(position))
    assert found.startswith(words)
    assert bool(found) == bool(words)


def test_on_the_floor_is_not_outside(box_scene):
    assert outside(box_scene, np.zeros(3)) == ""


def test_leaves_below_the_floor_do_not_lower_it():
    scene = get_scene("table", 2000)
    assert scene.mesh.vertices[:, 2].min() < -0.1
    assert floor_height(scene) == 0.0
