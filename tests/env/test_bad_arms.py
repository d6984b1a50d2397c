"""Arms that cannot be: one clear error each, as early as it can be known."""

import gymnasium as gym
import numpy as np
import pytest

import ms_slam_env  # noqa: F401 -- registers
from ms_slam_env.errors import InputError

TABLE = {"scene": "table", "scene_seed": 1000}

AT_ONCE = {
    "no such file": ({"model": "nope.xml"}, "unknown arm 'nope.xml'; valid choices: mico, or the"),
    "no camera": ({"camera_site": "eye"}, "no site named 'eye'; its sites: camera"),
    "unknown option": ({"modle": "mico"}, "'arm.modle'; valid choices: model, camera_site"),
    "unknown noise": ({"noise": {"play": 1}}, "'arm.noise.play'; valid choices: joint_offset_rad"),
    "half a frame": ({"frames_per_action": 1.5}, "frames_per_action = 1.5 must be an integer"),
    "too fast a camera": ({"camera_hz": 60}, r"camera_hz = 60 is outside \[0.1, 30\]"),
    "a base of three numbers": ({"base": (1, 2, 3)}, "must be four numbers, x, y, z and yaw"),
}


@pytest.mark.parametrize("case", AT_ONCE)
@pytest.mark.parametrize("embodiment", ["arm", "arm-kinematic"])
def test_refused_when_the_environment_is_made(case, embodiment):
    arm, message = AT_ONCE[case]
    with pytest.raises(InputError, match=message) as caught:
        gym.make("MSActiveSLAM-v0", embodiment=embodiment, arm=arm, **TABLE)
    assert "\n" not in str(caught.value)


def middle_of(scene, label):
    points, labels = scene.surface_points(0.05)
    its = points[labels == scene.mesh.labels.index(label)]
    return (its.min(axis=0) + its.max(axis=0)) / 2


def test_an_arm_inside_furniture():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", **TABLE).unwrapped
    env.reset(seed=0)
    x, y, z = (float(value) for value in middle_of(env.scene, "bookshelf"))
    inside = gym.make("MSActiveSLAM-v0", arm={"base": (x, y, z, 0.0)}, **TABLE)
    with pytest.raises(InputError, match=r"arm inside furniture: base at \[.*needs"):
        inside.reset(seed=0)


def test_a_start_pose_out_of_reach():
    env = gym.make("MSActiveSLAM-v0", **TABLE)
    start = np.diag([1.0, -1.0, -1.0, 1.0])
    start[:3, 3] = [1.5, 1.2, 2.2]  # looking down from under the ceiling
    with pytest.raises(InputError, match="T_world_camera: arm mico cannot hold the camera at"):
        env.reset(seed=0, options={"T_world_camera": start})
    _, info = env.reset(seed=0)  # nothing is lost
    assert info["tracking_ok"]
