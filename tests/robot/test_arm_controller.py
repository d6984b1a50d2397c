"""The controller: ways are followed, limits are kept, mink's own solution is the reference."""

import mink
import numpy as np
import pytest
from arm_reference import Balls
from numpy.testing import assert_allclose
from test_arm_model import ARMS

from ms_slam_env.geometry import make_pose, relative_angle, so3_exp
from ms_slam_env.robot.action_primitives import decompose
from ms_slam_env.robot.arm import ArmConfig, load_arm
from ms_slam_env.robot.arm.cartesian_path import CartesianPath
from ms_slam_env.robot.arm.chain import segment_distance
from ms_slam_env.robot.arm.clearance import ClearanceField, LinkClearance
from ms_slam_env.robot.arm.controller import LIMIT_MARGIN_RAD, Controller

MOTIONS = decompose(0.08, np.radians(10))
CONFIG = ArmConfig(clearance_m=0.02)


@pytest.fixture(params=ARMS, scope="module")
def arm(request):
    return load_arm(*ARMS[request.param])


@pytest.fixture(scope="module")
def mico():
    return load_arm("mico")


def controller_of(arm, *balls, config=CONFIG):
    clearance_field = ClearanceField(Balls(*balls), np.eye(4), 1.5)
    return Controller(arm, arm.chain, clearance_field, config)


def speeds(plan):
    return np.abs(np.diff(plan.q, axis=0)) / plan.tick_s


def test_every_small_motion_is_followed_at_legal_speed(arm):
    controller = controller_of(arm)
    start = arm.chain.camera_pose(arm.home)
    followed = 0
    for motion in MOTIONS:
        plan = controller.plan(arm.home, start @ motion, least_duration_s=1.5)
        assert (speeds(plan) <= arm.chain.speed * (1 + 1e-6)).all()
        assert arm.chain.within_limits(plan.q, LIMIT_MARGIN_RAD - 1e-9).all()
        assert_allclose(plan.q[0], arm.home)
        end = arm.chain.camera_pose(plan.q[-1])
        off_m = np.linalg.norm(end[:3, 3] - (start @ motion)[:3, 3])
        off_rad = relative_angle(end[:3, :3], (start @ motion)[:3, :3])
        assert_allclose([plan.error_m, plan.error_rad], [off_m, off_rad], atol=1e-7)
        if plan.followed:
            followed += 1
            times = plan.tick_s * np.arange(len(plan.q))
            way = CartesianPath(start, start @ motion, 0.2, np.radians(36), 1.5).at(times)
            cameras = arm.chain.camera_pose(plan.q)
            assert np.linalg.norm(cameras[:, :3, 3] - way[:, :3, 3], axis=1).max() < 0.002
            assert off_rad < np.radians(0.2)
    assert followed >= 45


def test_a_step_solves_minks_problem_with_minks_limits(mico):
    controller = controller_of(mico)
    mj = mico.mj
    limits = [
        mink.ConfigurationLimit(mj, 1.0, LIMIT_MARGIN_RAD),
        mink.VelocityLimit(mj, dict(zip(range(6), mico.chain.speed, strict=True))),
    ]
    configuration = mink.Configuration(mj)
    task = mink.FrameTask("camera", "site", 1.0, 1.0)
    rng = np.random.default_rng(0)
    bound = 0
    for _ in range(40):
        q = np.clip(
            mico.home + rng.uniform(-0.8, 0.8, 6),
            mico.chain.lower + LIMIT_MARGIN_RAD,
            mico.chain.upper - LIMIT_MARGIN_RAD,
        )
        target = mico.chain.camera_pose(q) @ make_pose(
            so3_exp(rng.normal(0, 0.012, 3)), rng.normal(0, 0.004, 3)
        )
        configuration.update(q)
        task.set_target(mink.SE3.from_matrix(target))
        velocity = mink.solve_ik(configuration, [task], 0.05, "daqp", 1e-5, limits=limits)
        controller._configuration.update(q)
        controller._task.set_target(mink.SE3.from_matrix(target))
        assert_allclose(controller._step(0.05, []), velocity * 0.05, atol=1e-7)
        bound += bool((np.abs(velocity) > mico.chain.speed * (1 - 1e-6)).any())
    assert 5 < bound < 40


def test_no_motion_is_one_configuration(mico):
    plan = controller_of(mico).plan(mico.home, mico.chain.camera_pose(mico.home))
    assert plan.followed
    assert plan.duration_s == 0
    assert_allclose(plan.q, mico.home[None])


@pytest.mark.parametrize("direction", [[1.5, 0, 0], [0, 0, 1.5], [-1.2, 0.3, -0.3]])
def test_what_is_out_of_reach_ends_in_a_legal_posture(arm, direction):
    controller = controller_of(arm)
    target = arm.chain.camera_pose(arm.home)
    target[:3, 3] += direction
    plan = controller.plan(arm.home, target)
    assert not plan.followed
    assert plan.error_m > 0.1
    assert arm.chain.within_limits(plan.q, LIMIT_MARGIN_RAD - 1e-9).all()
    assert (speeds(plan) <= arm.chain.speed * (1 + 1e-6)).all()
    assert controller.clearance.gaps(plan.q).min() > -0.006


def test_furniture_in_the_way_is_not_touched(mico):
    start = mico.chain.camera_pose(mico.home)
    target = start.copy()
    target[:3, 3] += 0.25 * start[:3, 2]
    ball = (start[:3, 3] + 0.3 * start[:3, 2], 0.08)
    free = controller_of(mico).plan(mico.home, target, 8.0)
    plan = controller_of(mico, ball).plan(mico.home, target, 8.0)
    assert free.followed
    assert not plan.followed
    assert surface_distance(mico, free.q, ball) < 0
    assert surface_distance(mico, plan.q, ball) > CONFIG.clearance_m - 0.004
    assert np.linalg.norm(plan.q[-1] - plan.q[0]) > 0.1  # it went as far as it could


def surface_distance(arm, q, ball):
    """Least distance of the moving capsules from a ball: points against segments."""
    moving = arm.chain.capsule_link > 0
    ends = arm.chain.capsules(q)[:, moving]
    point = np.broadcast_to(ball[0], ends.shape)
    return (segment_distance(ends, point) - arm.chain.capsule_radius[moving]).min() - ball[1]


def test_gaps_are_on_the_safe_side(arm):
    ball = (np.array([0.3, 0.3, 0.6]), 0.1)
    clearance_field = ClearanceField(Balls(ball), np.eye(4), 1.5)
    clearance = LinkClearance(arm.chain, clearance_field, 0.02)
    rng = np.random.default_rng(0)
    q = arm.home + rng.uniform(-1.5, 1.5, (200, arm.chain.num_joints))
    gaps, least = clearance.gaps(q), clearance.least(q)
    true = np.array([surface_distance(arm, one[None], ball) for one in q])
    balls = clearance.balls(q).shape[1]
    furniture = gaps[:, :balls].min(axis=1)
    outside = true > 0
    assert (furniture <= true - 0.02 + 1e-3)[outside].all()  # 1 mm: a ball bends within a voxel
    near = outside & (true < 0.3)
    assert (true - furniture)[near].max() < 0.02 + 0.025 + 0.06
    pairs = arm.chain.self_pairs
    ends, radius = arm.chain.capsules(q), arm.chain.capsule_radius
    apart = segment_distance(ends[:, pairs[:, 0]], ends[:, pairs[:, 1]])
    apart -= radius[pairs].sum(axis=1)
    assert_allclose(gaps[:, balls:], apart - np.minimum(0.02, arm.chain.self_gap / 2))
    assert (least >= np.minimum(gaps.min(axis=1), 0) - 1e-12).all()
    assert (least[true < 0.02] < 0).all()
    assert (least <= np.minimum(gaps[:, balls:].min(axis=1), 0) + 1e-12).all()


def test_two_plans_are_one(mico):
    target = mico.chain.camera_pose(mico.home) @ MOTIONS[20]
    used = controller_of(mico)
    used.plan(mico.home + 0.1, target)
    a, b = used.plan(mico.home, target), controller_of(mico).plan(mico.home, target)
    np.testing.assert_array_equal(a.q, b.q)
