"""Where an arm stands when an episode begins, and what is refused."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.errors import InputError, UnreachableError
from ms_slam_env.geometry import invert, look_at, make_pose, so3_exp, transform_points
from ms_slam_env.robot.action_primitives import decompose
from ms_slam_env.robot.arm import ArmConfig, load_arm
from ms_slam_env.robot.arm.base_placement import COLUMN_RADIUS_M, place_arm, reach_m, standing_chain
from ms_slam_env.robot.arm.clearance import ClearanceField
from ms_slam_env.robot.arm.feasibility import Feasibility
from ms_slam_env.robot.arm.inverse_kinematics import PITCHES, ik_seeds_at, turn_upright
from ms_slam_env.sensor.scene_cache import get_scene

MOTIONS = decompose(0.12, np.radians(12))
CONFIG = ArmConfig()


@pytest.fixture(scope="module")
def arm():
    return load_arm("mico")


def rng():
    return np.random.default_rng(0)


def possible(arm, scene, config, T_world_base, q):
    chain = standing_chain(arm, config)
    feasibility = Feasibility(chain, ClearanceField(scene, T_world_base, reach_m(chain)), config)
    return int(feasibility.probe(q, chain.camera_pose(q) @ MOTIONS).ok.sum())


@settings(max_examples=25, deadline=None)
@given(
    yaw=st.floats(-np.pi, np.pi),
    pitch=st.floats(-1.3, 0.7),
    roll=st.floats(-0.06, 0.06),
    height=st.floats(0.7, 1.6),
)
def test_the_camera_is_where_it_should_be_and_the_base_upright(
    arm, box_scene, yaw, pitch, roll, height
):
    eye = np.array([-0.3, -0.7, height])
    ahead = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
    T = look_at(eye, eye + np.array(ahead))
    T[:3, :3] = T[:3, :3] @ so3_exp([0, 0, roll])
    T_world_base, q = place_arm(arm, box_scene, T, CONFIG)
    np.testing.assert_allclose(T_world_base @ arm.chain.camera_pose(q), T, atol=1e-9)
    np.testing.assert_allclose(T_world_base[:3, 2], [0, 0, 1], atol=1e-8)
    assert arm.chain.within_limits(q)
    assert T_world_base[2, 3] >= 0
    ends = arm.chain.capsules(q)[1:]  # what moves
    points = ends[:, :1] + np.linspace(0, 1, 9)[:, None] * np.diff(ends, axis=1)
    free = box_scene.clearance(transform_points(T_world_base, points.reshape(-1, 3)))
    assert (free >= np.repeat(arm.chain.capsule_radius[1:], 9)).all()
    column = T_world_base[:3, 3] * np.linspace([1, 1, 0.2], 1, 20)
    assert (box_scene.clearance(column) >= np.minimum(column[:, 2], COLUMN_RADIUS_M) - 0.05).all()
    assert possible(arm, box_scene, CONFIG, T_world_base, q) >= 25


@pytest.mark.parametrize("name", ["wall", "table"])
def test_most_drawn_starts_can_be_held_with_most_motions(arm, name):
    scene, draw = get_scene(name, 1000), rng()
    counts = []
    for _ in range(10):
        try:
            T_world_base, q = place_arm(arm, scene, scene.sample_start(draw), CONFIG)
        except UnreachableError:
            continue
        counts.append(possible(arm, scene, CONFIG, T_world_base, q))
    assert len(counts) >= 8
    assert np.mean(counts) >= 40


def test_it_is_the_same_every_time(arm, box_scene):
    T = look_at([0.1, -0.8, 1.2], [1.2, 0.0, 0.6])
    first = place_arm(arm, box_scene, T, CONFIG)
    second = place_arm(arm, box_scene, T, CONFIG)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_postures_have_their_pitch_and_no_roll_and_stand_apart(arm):
    chain = standing_chain(arm, CONFIG)
    for index in (4, 9):
        good = ik_seeds_at(chain, tuple(arm.home), ArmConfig(), index)
        camera = chain.camera_pose(good.q)
        np.testing.assert_allclose(np.arcsin(camera[:, 2, 2]), PITCHES[index], atol=1e-6)
        np.testing.assert_allclose(camera[:, 2, 0], 0, atol=1e-8)  # no roll: right is level
        assert (camera[:, 2, 1] <= 1e-8).all()  # down is down
        assert (np.diff(good.motions) <= 0).all()
        assert good.motions[0] >= 40
        base = invert(camera)[:, :3, 3]
        apart = np.linalg.norm(base[:, None] - base, axis=-1) + np.eye(len(base))
        assert apart.min() >= 0.06


@pytest.mark.filterwarnings("error")
def test_hinges_without_limits_are_bent_at_most_half_a_turn(box_scene, tmp_path):
    text = (Path(__file__).parent / "second_arm.xml").read_text()
    hinges, *finger = re.split(r'(?=<body name="finger")', text)
    file = tmp_path / "unlimited.xml"
    file.write_text(re.sub(r' range="[^"]*"', "", hinges) + "".join(finger))
    model = load_arm(str(file), "lens")
    assert np.isinf(model.chain.lower).all()
    T = look_at([0.1, -0.8, 1.2], [1.2, 0.0, 0.6])
    T_world_base, q = place_arm(model, box_scene, T, CONFIG)
    np.testing.assert_allclose(T_world_base @ model.chain.camera_pose(q), T, atol=1e-9)
    assert (np.abs(q) <= np.pi).all()


def test_turning_upright_says_where_it_fails(arm):
    q, done = turn_upright(arm.chain, arm.home[None], np.array([0.0, 0.0, 1.0]))
    up = arm.chain.camera_pose(q)[:, 2, :3]
    np.testing.assert_array_equal(done, np.linalg.norm(up - [0, 0, 1], axis=1) < 1e-8)


def test_a_place_without_floor_is_refused_in_one_line(arm, box_scene):
    inside_a_box = make_pose(np.eye(3), [1.2, 0.0, 0.4])
    in_a_corner = look_at([1.95, 1.95, 2.4], [1.95, 1.95, 2.0])
    for T in (inside_a_box, in_a_corner):
        with pytest.raises(UnreachableError) as error:
            place_arm(arm, box_scene, T, CONFIG)
        assert "\n" not in str(error.value)
        assert "scene box" in str(error.value)
    assert "arm mico cannot hold the camera at" in str(error.value)


# -- a given base ----------------------------------------------------------------------------


def test_a_given_base_stays_and_the_camera_is_where_it_should_be(arm, box_scene):
    base = (-0.5, -0.8, 0.6, 0.4)
    T_world_base = make_pose(so3_exp([0, 0, 0.4]), base[:3])
    T = T_world_base @ arm.chain.camera_pose(arm.home + 0.3)
    stood, q = place_arm(arm, box_scene, T, ArmConfig(base=base))
    np.testing.assert_allclose(stood, T_world_base, atol=1e-12)
    np.testing.assert_allclose(stood @ arm.chain.camera_pose(q), T, atol=1e-5)
    assert arm.chain.within_limits(q)


def test_a_base_on_top_of_furniture_is_fine(arm, box_scene):
    base = (1.25, 0.05, 0.8, np.pi)  # on the box
    T = make_pose(so3_exp([0, 0, np.pi]), base[:3]) @ arm.chain.camera_pose(arm.home)
    stood, _ = place_arm(arm, box_scene, T, ArmConfig(base=base))
    assert stood[2, 3] == 0.8


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ((1.25, 0.05, 0.4, 0.0), r"arm inside furniture: arm.base at .* has .* needs"),
        ((1.25, 0.05, 0.0, 0.0), r"arm inside furniture: arm.base at .* has .* needs"),
        ((9.0, 0.0, 0.5, 0.0), r"lies outside scene box, which spans -2.00 to 2.00 x -2.00 to"),
        ((0.0, 0.0, -0.5, 0.0), r"lies below the floor of scene box, which is at z = 0.00 m"),
    ],
)
def test_a_base_inside_furniture_or_outside_is_refused(arm, box_scene, base, message):
    T = make_pose(np.eye(3), base[:3]) @ arm.chain.camera_pose(arm.home)
    with pytest.raises(InputError, match=message) as error:
        place_arm(arm, box_scene, T, ArmConfig(base=base))
    assert not isinstance(error.value, UnreachableError)  # another start pose would not help


def test_why_a_start_pose_cannot_be_held_is_said(arm, box_scene):
    config = ArmConfig(base=(-0.5, -0.8, 0.1, 0.0))

    def why(T):
        with pytest.raises(UnreachableError) as error:
            place_arm(arm, box_scene, T, config)
        return str(error.value)

    assert "unreachable for arm mico from base" in why(make_pose(np.eye(3), [1.5, 1.5, 1.5]))
    angles = arm.home + rng().uniform(-1.5, 1.5, (500, 6))
    cameras = arm.chain.camera_pose(angles[arm.chain.within_limits(angles)])
    cameras = make_pose(np.eye(3), [-0.5, -0.8, 0.1]) @ cameras
    cameras = cameras[np.abs(cameras[:, 2, 3] - 0.03) < 0.02]
    low = max(cameras, key=lambda T: float(np.linalg.norm(T[:2, 3] - [-0.5, -0.8])))
    assert "touch furniture" in why(low)
    low[2, 3] = -0.03
    assert "lies below the floor of scene box" in why(low)
