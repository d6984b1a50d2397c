"""The Mico of the package against the figures it was written from."""

import itertools

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from ms_slam_env.robot.arm import ArmConfig, load_arm

D1, D2, D3, D4, D5, D6, E2 = 0.2755, 0.2900, 0.1233, 0.0741, 0.0741, 0.1600, 0.0070
HALF_BEND = np.radians(30)

# Joint origins of Kinova's ROS description of the m1n6s200: xyz, rpy; every axis is z.
URDF_JOINTS = (
    ((0, 0, 0.15675), (0, np.pi, 0)),
    ((0, 0.0016, -0.11875), (-np.pi / 2, 0, np.pi)),
    ((0, -0.290, 0), (0, np.pi, 0)),
    ((0, 0.1231, -0.0086), (-np.pi / 2, 0, np.pi)),
    ((0, -0.03703, -0.06414), (np.pi / 3, 0, np.pi)),
    ((0, -0.03703, -0.06414), (np.pi / 3, 0, np.pi)),
)
URDF_END_EFFECTOR = ((0, 0, -0.16), (np.pi, 0, np.pi / 2))


def pose_of(xyz, rpy):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    T[:3, 3] = xyz
    return T


def dh_row(alpha, a, d, theta):
    """One classic Denavit-Hartenberg transform."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array(
        [[c, -ca * s, sa * s, a * c], [s, ca * c, -sa * c, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    )


def dh_product(q):
    """Kinova, DH Parameters of Mico, version 1.0.1, 2013."""
    sa, s2a = np.sin(HALF_BEND), np.sin(2 * HALF_BEND)
    d4b, d5b, d6b = D3 + sa / s2a * D4, sa / s2a * (D4 + D5), sa / s2a * D5 + D6
    quarter, half = np.pi / 2, np.pi
    rows = (
        (quarter, 0, D1, -q[0]),
        (half, D2, 0, q[1] - quarter),
        (quarter, 0, -E2, q[2] + quarter),
        (2 * HALF_BEND, 0, -d4b, q[3]),
        (2 * HALF_BEND, 0, -d5b, q[4] - half),
        (half, 0, -d6b, q[5] + quarter),
    )
    T = np.eye(4)
    for row in rows:
        T = T @ dh_row(*row)
    return T


def urdf_product(q):
    T = np.eye(4)
    for origin, angle in zip(URDF_JOINTS, q, strict=True):
        T = T @ pose_of(*origin) @ pose_of((0, 0, 0), (0, 0, angle))
    return T @ pose_of(*URDF_END_EFFECTOR)


def configurations():
    rng = np.random.default_rng(0)
    every_zero_or_quarter = list(itertools.product((0.0, np.pi / 2), repeat=6))
    return np.array([*every_zero_or_quarter, *rng.uniform(-2 * np.pi, 2 * np.pi, (100, 6))])


@pytest.fixture(scope="module")
def mico():
    return load_arm("mico")


def place(arm, q):
    data = mujoco.MjData(arm.mj)
    data.qpos[arm.qpos] = q
    mujoco.mj_kinematics(arm.mj, data)
    return data


def body_pose(arm, data, name):
    body = arm.mj.body(name).id
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    return T


def test_mujoco_agrees_with_the_dh_product(mico):
    for q in configurations():
        assert_allclose(body_pose(mico, place(mico, q), "end_effector"), dh_product(q), atol=1e-9)


def test_chain_agrees_with_the_dh_product(mico):
    home = place(mico, mico.home)
    site = np.eye(4)
    site[:3, :3] = home.site_xmat[mico.camera_site].reshape(3, 3)
    site[:3, 3] = home.site_xpos[mico.camera_site]
    T_hand_camera = np.linalg.inv(body_pose(mico, home, "end_effector")) @ site
    q = configurations()
    expected = np.stack([dh_product(one) for one in q]) @ T_hand_camera
    assert_allclose(mico.chain.camera_pose(q), expected, atol=1e-9)


def test_pose_agrees_with_the_ros_description(mico):
    """An independent publication of the same arm: its numbers are rounded to tenths of mm."""
    for q in configurations():
        ours, ros = body_pose(mico, place(mico, q), "end_effector"), urdf_product(q)
        assert np.linalg.norm(ours[:3, 3] - ros[:3, 3]) < 0.001
        assert_allclose(ours[:3, :3], ros[:3, :3], atol=1e-9)


def test_limits_are_kinovas(mico):
    chain = mico.chain
    turns = 4 * np.pi / 2
    assert_allclose(np.degrees(chain.lower[1:3]), [50, 35], atol=0.01)
    assert_allclose(np.degrees(chain.upper[1:3]), [310, 325], atol=0.01)
    continuous = [0, 3, 4, 5]
    assert_allclose(chain.lower[continuous], -turns, atol=1e-4)
    assert_allclose(chain.upper[continuous], turns, atol=1e-4)
    assert_allclose(np.degrees(chain.speed), [36, 36, 36, 48, 48, 48], atol=0.01)
    assert ArmConfig().speed_m_s == 0.2


def test_masses_are_kinovas(mico):
    mass = {mico.mj.body(i).name: mico.mj.body_mass[i] for i in range(mico.mj.nbody)}
    assert_allclose(
        [mass[name] for name in ("shoulder", "arm", "forearm", "wrist_1", "wrist_2")],
        [0.748, 0.860, 0.606, 0.179, 0.179],
        atol=0.001,
    )
    assert_allclose(mass["hand"], 0.780 + 4 * 0.010, atol=1e-9)
    assert_allclose(mass["camera_body"], 0.25, atol=1e-9)


def test_camera_has_the_size_of_an_xtion_and_looks_away_from_the_hand(mico):
    box = mico.mj.geom("camera")
    assert_allclose(2 * box.size, [0.18, 0.035, 0.05])
    data = place(mico, mico.home)
    axes = data.site_xmat[mico.camera_site].reshape(3, 3)
    hand = body_pose(mico, data, "hand")
    assert_allclose(axes[:, 2], -hand[:3, 2], atol=1e-9)  # the hand reaches along its -z
    R_box = data.geom_xmat[box.id].reshape(3, 3)
    assert_allclose(axes, R_box, atol=1e-9)  # x along the long side, y down the short one
    ahead = axes[:, 2] @ (data.site_xpos[mico.camera_site] - data.geom_xpos[box.id])
    assert ahead >= box.size[2]  # the lens lies before the body, so no image shows it


def test_gravity_compensation_carries_the_arm_but_not_the_camera(mico):
    """The camera's weight alone remains, at any posture: the arm sags by it."""
    data = place(mico, mico.home)
    mujoco.mj_forward(mico.mj, data)
    weight = data.qfrc_bias[mico.dof] - data.qfrc_gravcomp[mico.dof]
    jacobian = np.zeros((3, mico.mj.nv))
    camera = mico.mj.body("camera_body").id
    mujoco.mj_jacBodyCom(mico.mj, data, jacobian, None, camera)
    assert_allclose(weight, 0.25 * 9.81 * jacobian[2, mico.dof], atol=1e-9)


def test_home_is_within_limits_and_touches_nothing(mico):
    assert mico.chain.within_limits(mico.home, margin_rad=0.05)
    data = place(mico, mico.home)
    mujoco.mj_collision(mico.mj, data)
    assert data.ncon == 0
