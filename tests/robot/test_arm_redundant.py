"""The mask of an arm with more joints than it needs: limits, the slow version, the controller."""

from pathlib import Path

import numpy as np
import pytest
from arm_reference import Balls, follow

from ms_slam_env.robot.action_primitives import decompose
from ms_slam_env.robot.arm import ArmConfig, load_arm
from ms_slam_env.robot.arm.clearance import ClearanceField
from ms_slam_env.robot.arm.controller import Controller
from ms_slam_env.robot.arm.feasibility import LIMIT_MARGIN_RAD, MOST_STRETCH, Feasibility

MOTIONS = decompose(0.12, np.radians(12))
CONFIG = ArmConfig()


@pytest.fixture(scope="module")
def second():
    return load_arm(str(Path(__file__).with_name("second_arm.xml")), "lens")


def near_a_limit(second, count, seed=0):
    """Joint angles of the redundant arm of which one is within 0.15 rad of its limit."""
    chain, rng = second.chain, np.random.default_rng(seed)
    for index in range(count):
        joint = (1, 3, 5)[index % 3]
        q = second.home + rng.uniform(-0.6, 0.6, 7)
        q = np.clip(q, chain.lower + 0.1, chain.upper - 0.1)
        q[joint] = chain.upper[joint] - rng.uniform(0.02, 0.15)
        yield q


def test_a_redundant_arm_bends_around_its_limits_as_the_slow_version_does(second):
    open_space = ClearanceField(Balls(), np.eye(4), 2.0)
    feasibility = Feasibility(second.chain, open_space, CONFIG)
    rng = np.random.default_rng(0)
    low, high = second.chain.lower + LIMIT_MARGIN_RAD, second.chain.upper - LIMIT_MARGIN_RAD
    bent = 0
    for q in near_a_limit(second, 12):
        targets = second.chain.camera_pose(q) @ MOTIONS
        result = feasibility.probe(q, targets)
        at_limit = ((result.q < low + 1e-5) | (result.q > high - 1e-5)).any(axis=(1, 2))
        bending, others = np.flatnonzero(result.ok & at_limit), np.flatnonzero(result.ok)[1:]
        bent += len(bending[:3])
        for k in (*bending[:3], *rng.permutation(others)[:1]):
            way = follow(second.chain, open_space, CONFIG, q, targets[k], result.q.shape[1])
            assert not way.broken(slack=1e-3), (k, way)
            np.testing.assert_allclose(result.q[k], way.q, atol=1e-2)
    assert bent > 10


def test_mask_and_controller_agree_on_a_redundant_arm(second):
    open_space = ClearanceField(Balls(), np.eye(4), 2.0)
    feasibility = Feasibility(second.chain, open_space, CONFIG)
    controller = Controller(second, second.chain, open_space, CONFIG)
    rng = np.random.default_rng(0)
    agrees, apart = [], []
    for q in near_a_limit(second, 12, seed=1):
        targets = second.chain.camera_pose(q) @ MOTIONS
        result = feasibility.probe(q, targets)
        for k in rng.choice(np.arange(1, 49), 5, replace=False):
            stretch = 1.0 if result.ok[k] else MOST_STRETCH
            plan = controller.plan(q, targets[k], stretch * result.duration_s[k])
            agrees.append(plan.followed == result.ok[k])
            if plan.followed and result.ok[k]:
                apart.append(np.abs(plan.q[-1] - result.q[k, -1]).max())
    assert np.mean(agrees) > 0.96
    assert 30 < len(apart) < 55
    assert np.median(apart) < 0.01
    assert max(apart) < 0.1


def test_a_redundant_arm_keeps_its_limits_and_speeds(second):
    chain = second.chain
    feasibility = Feasibility(chain, ClearanceField(Balls(), np.eye(4), 2.0), CONFIG)
    for q in (second.home, *near_a_limit(second, 6)):
        targets = chain.camera_pose(q) @ MOTIONS
        result = feasibility.probe(q, targets)
        assert result.ok.sum() > 5
        ends = chain.camera_pose(result.q[result.ok, -1])
        np.testing.assert_allclose(ends, targets[result.ok], atol=1.8e-3)
        assert chain.within_limits(result.q[result.ok], LIMIT_MARGIN_RAD - 1e-5).all()
        moving = result.ok & (result.duration_s > 0)
        steps = np.abs(np.diff(result.q, axis=1)) * (result.q.shape[1] - 1)
        speed = steps[moving] / result.duration_s[moving, None, None]
        assert (speed <= chain.speed * (1 + 1e-4)).all()
