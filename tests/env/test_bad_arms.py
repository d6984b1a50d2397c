"""Arms that cannot be: one clear error each, as early as it can be known."""

import gymnasium as gym
import numpy as np
import pytest

import ms_slam_env  # noqa: F401 -- registers
from ms_slam_env.errors import InputError

TABLE = {"scene": "table", "scene_seed": 1000}

AT_ONCE = {
    "no such file": (
        {"model": "nope.xml"},
        "arm.model 'nope.xml': no such file; valid choices: mico, or the",
    ),
    "no camera": (
        {"camera_site": "eye"},
        "no site named 'eye'; its sites: camera; set arm.camera_site to one",
    ),
    "unknown option": ({"modle": "mico"}, "'arm.modle'; valid choices: model, camera_site"),
    "unknown noise": ({"noise": {"play": 1}}, "'arm.noise.play'; valid choices: joint_offset_rad"),
    "unknown name of noise": ({"noise": "some"}, "'some' must be 'none' or 'default' or a mapping"),
    "no noise at all": ({"noise": None}, "of options: joint_offset_rad, encoder_rad, hand_eye_m"),
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
    with pytest.raises(InputError, match=r"^arm inside furniture: arm.base at \[.*needs"):
        inside.reset(seed=0)


@pytest.mark.parametrize(
    ("base", "message"),
    [
        (
            (50, 0, 0, 0),
            r"^arm.base at \[50.0, 0.0, 0.0\] lies outside scene table, which spans 0.00",
        ),
        ((1.0, 1.0, -0.5, 0), r"^arm.base at .* lies below the floor .* at z = 0.00 m"),
        ((0.4, 0.4, 2.2, 0), r"^none of 10 drawn start poses .* away from the base, the arm holds"),
    ],
)
def test_a_base_that_serves_no_start(base, message):
    env = gym.make("MSActiveSLAM-v0", arm={"base": base}, **TABLE)
    with pytest.raises(InputError, match=message) as caught:
        env.reset(seed=0)
    assert "\n" not in str(caught.value)


def test_an_arm_without_a_posture_for_the_camera(tmp_path):
    """One hinge about the vertical and a camera that looks up: it can never look ahead."""
    file = tmp_path / "one_joint.xml"
    file.write_text(
        '<mujoco><worldbody><body><joint name="j" axis="0 0 1"/><geom size="0.1"/>'
        '<site name="camera"/></body></worldbody>'
        '<actuator><position joint="j" kp="10"/></actuator></mujoco>'
    )
    env = gym.make("MSActiveSLAM-v0", arm={"model": str(file)}, **TABLE)
    with pytest.raises(InputError, match="arm one_joint has no posture that holds the camera") as e:
        env.reset(seed=0)
    assert "\n" not in str(e.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            '<mujoco><worldbody><body><joint name="j"/><geom size="0.1"/><camera name="camera"/>'
            "</body></worldbody></mujoco>",
            "no site named 'camera'; its sites: none; its <camera> elements do not count: "
            'add <site name="camera" pos="..." quat="..."/>',
        ),
        ('<robot name="x"><link name="a"/></robot>', "is a URDF; an MJCF is needed"),
    ],
)
def test_a_file_that_is_nearly_an_arm(tmp_path, text, message):
    file = tmp_path / "nearly.xml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        gym.make("MSActiveSLAM-v0", arm={"model": str(file)}, **TABLE)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "env_id", ["MSActiveSLAM-FreeCamera-v0", "MSActiveSLAM-FixedTranslation-v0"]
)
@pytest.mark.parametrize(
    "options", [{"pose": "kinematics"}, {"pose": "slam-kinematics"}, {"arm": {"noise": "none"}}]
)
def test_a_free_camera_has_no_arm(env_id, options):
    with pytest.raises(InputError, match="needs an arm: embodiment='arm' or 'arm-kinematic'"):
        gym.make(env_id, **options, **TABLE)
    gym.make(env_id, embodiment="arm-kinematic", **options, **TABLE)


def test_a_start_pose_below_the_floor():
    env = gym.make("MSActiveSLAM-v0", **TABLE)
    start = np.eye(4)
    start[:3, 3] = [1.5, 1.2, -1.0]
    with pytest.raises(InputError, match=r"start pose .* lies below the floor of scene table"):
        env.reset(seed=0, options={"T_world_camera": start})


def test_a_start_pose_out_of_reach():
    env = gym.make("MSActiveSLAM-v0", **TABLE)
    start = np.diag([1.0, -1.0, -1.0, 1.0])
    start[:3, 3] = [1.5, 1.2, 2.2]  # looking down from under the ceiling
    with pytest.raises(InputError, match="T_world_camera: arm mico cannot hold the camera at"):
        env.reset(seed=0, options={"T_world_camera": start})
    _, info = env.reset(seed=0)  # nothing is lost
    assert info["tracking_ok"]
