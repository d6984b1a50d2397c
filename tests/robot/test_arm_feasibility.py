"""The mask's kernel against a slow version, and the distances that it uses."""

import numpy as np
import pytest
from arm_reference import Balls, follow
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env.geometry import invert, make_pose, so3_exp, transform_points
from ms_slam_env.robot.action_primitives import decompose
from ms_slam_env.robot.arm import ArmConfig, load_arm
from ms_slam_env.robot.arm.chain import with_column
from ms_slam_env.robot.arm.clearance import ClearanceField
from ms_slam_env.robot.arm.feasibility import MOST_STRETCH, REASONS, Feasibility
from ms_slam_env.robot.arm.inverse_kinematics import solve_pose

MOTIONS = decompose(0.12, np.radians(12))
CONFIG = ArmConfig()
BASE = make_pose(so3_exp([0, 0, 0.7]), [0.3, 0.2, 0.75])  # beside a box, 0.8 m high


@pytest.fixture(scope="module")
def arm():
    return load_arm("mico")


@pytest.fixture(scope="module")
def furnished(arm):
    """A post beside the camera at home, in the way of some motions."""
    camera = transform_points(BASE, arm.chain.camera_pose(arm.home)[:3, 3])
    post = camera + transform_points(BASE, [[-0.2, 0.1, 0.05]])[0] - BASE[:3, 3]
    return ClearanceField(Balls((post, 0.08)), BASE, 1.4)


def postures(arm, clearance_field, count, seed=0):
    """Joint angles inside limits at which the links are close to furniture, but free."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(3000):
        q = arm.home + rng.uniform(-0.7, 0.7, len(arm.home))
        ends = arm.chain.capsules(q)[arm.chain.capsule_link > 0]
        points = (ends[:, :1] + np.linspace(0, 1, 9)[:, None] * np.diff(ends, axis=1)).reshape(
            -1, 3
        )
        radius = np.repeat(arm.chain.capsule_radius[arm.chain.capsule_link > 0], 9)
        gap = (clearance_field.distance(points) - radius).min()
        if 0.03 < gap < 0.15 and arm.chain.within_limits(q, 0.05):
            found.append(q)
        if len(found) == count:
            break
    return found


def test_it_agrees_with_the_slow_version(arm, furnished):
    feasibility = Feasibility(arm.chain, furnished, CONFIG)
    rng = np.random.default_rng(1)
    reasons = set()
    for q in postures(arm, furnished, 8):
        targets = arm.chain.camera_pose(q) @ MOTIONS
        result = feasibility.probe(q, targets)
        refused = rng.permutation(np.flatnonzero(~result.ok))[:2]
        made = rng.permutation(np.flatnonzero(result.ok)[1:])[:2]
        for k in (*refused, *made):
            way = follow(arm.chain, furnished, CONFIG, q, targets[k], result.q.shape[1])
            reasons.add(REASONS[result.reason[k]])
            if result.ok[k]:
                assert not way.broken(slack=1e-3), (k, way)
                np.testing.assert_allclose(result.q[k], way.q, atol=5e-3)
                camera = 1.25 * max(
                    np.linalg.norm(MOTIONS[k, :3, 3]) / CONFIG.speed_m_s,
                    (np.radians(12) if k % 7 else 0) / CONFIG.speed_rad_s,
                )
                assert result.duration_s[k] == pytest.approx(
                    camera * max(1.0, way.stretch), rel=0.02
                )
            else:  # the balls that cover a capsule stand out from it by less than 12 mm
                why = REASONS[result.reason[k]]
                why = "way" if why in ("unreachable", "joint limit") else why
                assert why in way.broken(slack=-0.012), (k, why, way)
    assert {"ok", "furniture", "joint speed"} <= reasons


def test_the_ends_are_reached_and_the_starts_kept(arm, furnished):
    q = postures(arm, furnished, 1)[0]
    targets = arm.chain.camera_pose(q) @ MOTIONS
    result = Feasibility(arm.chain, furnished, CONFIG).probe(q, targets)
    np.testing.assert_array_equal(result.q[:, 0], np.tile(q, (49, 1)))
    ends = arm.chain.camera_pose(result.q[result.ok, -1])
    np.testing.assert_allclose(ends, targets[result.ok], atol=1.8e-3)
    assert (np.linalg.norm((ends - targets[result.ok])[:, :3, 3], axis=1) < 1e-3).all()


def test_standing_still_is_possible_and_takes_no_time(arm, furnished):
    q = postures(arm, furnished, 1)[0]
    result = Feasibility(arm.chain, furnished, CONFIG).probe(
        q, arm.chain.camera_pose(q) @ MOTIONS[:1]
    )
    assert result.ok.all()
    assert result.duration_s[0] == 0
    np.testing.assert_array_equal(result.q[0], np.tile(q, (result.q.shape[1], 1)))


def test_one_and_many_agree_bit_for_bit_and_so_does_a_second_time(arm, furnished):
    q = postures(arm, furnished, 1, seed=5)[0]
    targets = arm.chain.camera_pose(q) @ MOTIONS
    feasibility = Feasibility(arm.chain, furnished, CONFIG)
    all_at_once = feasibility.probe(q, targets)
    feasibility.probe(q + 0.01, targets)
    again = Feasibility(arm.chain, furnished, CONFIG).probe(q, targets)
    np.testing.assert_array_equal(all_at_once.q[all_at_once.ok], again.q[again.ok])
    np.testing.assert_array_equal(all_at_once.reason, again.reason)
    for k in range(49):
        alone = feasibility.probe(q, targets[k : k + 1])
        assert alone.reason[0] == all_at_once.reason[k]
        if alone.ok[0]:
            np.testing.assert_array_equal(alone.q[0], all_at_once.q[k])
            assert alone.duration_s[0] == all_at_once.duration_s[k]


def test_results_are_not_overwritten_by_the_next_probe(arm, furnished):
    first, second = postures(arm, furnished, 2)
    feasibility = Feasibility(arm.chain, furnished, CONFIG)
    kept = feasibility.probe(first, arm.chain.camera_pose(first) @ MOTIONS)
    before = kept.q.copy(), kept.reason.copy(), kept.duration_s.copy()
    feasibility.probe(second, arm.chain.camera_pose(second) @ MOTIONS)
    for old, now in zip(before, (kept.q, kept.reason, kept.duration_s), strict=True):
        np.testing.assert_array_equal(old, now)


def test_the_reason_is_given(arm):
    open_space = ClearanceField(Balls(), np.eye(4), 1.3)
    q = arm.home

    def why(target, config=CONFIG, clearance_field=open_space, start=q):
        feasibility = Feasibility(arm.chain, clearance_field, config)
        return REASONS[feasibility.probe(start, target[None]).reason[0]]

    T = arm.chain.camera_pose(q)
    hurried = ArmConfig(speed_m_s=5, speed_rad_s=20)
    assert why(T @ MOTIONS[7], hurried) == "joint speed"
    edge = q.copy()
    edge[1] = arm.chain.lower[1] + 0.05
    pushed = edge.copy()
    pushed[1] -= 0.1
    assert why(arm.chain.camera_pose(pushed), start=edge) == "joint limit"
    solid = ClearanceField(_Below(T[2, 3] - 0.05), np.eye(4), 1.3)
    down = T.copy()
    down[2, 3] -= 0.05
    assert why(down, clearance_field=solid) == "furniture"


def test_folding_the_arm_onto_itself_is_refused(arm):
    open_space = ClearanceField(Balls(), np.eye(4), 1.3)
    feasibility = Feasibility(arm.chain, open_space, CONFIG)
    rng = np.random.default_rng(0)
    seen = 0
    for _ in range(200):
        q = arm.home + rng.uniform(-1.5, 1.5, 6)
        if not arm.chain.within_limits(q, 0.1):
            continue
        result = feasibility.probe(q, arm.chain.camera_pose(q) @ MOTIONS)
        seen += int((result.reason == REASONS.index("self-collision")).sum())
        if seen > 50:
            break
    assert seen > 50


def test_an_arm_that_is_too_close_may_leave_but_not_come_closer(arm):
    q = arm.home
    T = arm.chain.camera_pose(q)
    lowest = _lowest(arm, q)
    floor = ClearanceField(_Below(lowest - 0.01), np.eye(4), 1.3)  # 1 cm instead of 2
    feasibility = Feasibility(arm.chain, floor, CONFIG)
    up, down = T.copy(), T.copy()
    up[2, 3] += 0.05
    down[2, 3] -= 0.05
    result = feasibility.probe(q, np.stack([up, down]))
    assert result.ok[0]
    assert REASONS[result.reason[1]] == "furniture"


def test_long_ways_are_cut_finer(arm):
    open_space = ClearanceField(Balls(), np.eye(4), 1.3)
    feasibility = Feasibility(arm.chain, open_space, CONFIG)
    T = arm.chain.camera_pose(arm.home)
    far = feasibility.probe(arm.home, (T @ make_pose(np.eye(3), [0, 0, -0.4]))[None])
    turned = feasibility.probe(arm.home, (T @ make_pose(so3_exp([0, 0, 1.0]), [0, 0, 0]))[None])
    assert far.q.shape[1] == 24
    assert turned.q.shape[1] == 34


def test_a_slow_joint_stretches_the_motion_up_to_a_limit(arm):
    open_space = ClearanceField(Balls(), np.eye(4), 1.3)
    targets = arm.chain.camera_pose(arm.home) @ MOTIONS
    easy = Feasibility(arm.chain, open_space, ArmConfig(speed_m_s=0.01, speed_rad_s=0.03))
    hard = Feasibility(arm.chain, open_space, ArmConfig(speed_m_s=0.2, speed_rad_s=0.6))
    relaxed, hurried = easy.probe(arm.home, targets), hard.probe(arm.home, targets)
    assert (relaxed.ok >= hurried.ok).all()
    at_most = 1.25 * np.maximum(0.12 / 0.2, np.radians(12) / 0.6) * MOST_STRETCH * 1.05
    assert (hurried.duration_s[hurried.ok] <= at_most * (1 + 1e-5)).all()
    steps = np.abs(np.diff(hurried.q, axis=1)) * (hurried.q.shape[1] - 1)
    ok = hurried.ok & (hurried.duration_s > 0)
    speed = steps[ok] / hurried.duration_s[ok, None, None]
    assert (speed <= arm.chain.speed * (1 + 1e-4)).all()


def test_the_column_below_the_base_is_not_touched(arm):
    chain = with_column(arm.chain, arm.home, 0.08, 1.2)
    assert len(chain.capsule_radius) == len(arm.chain.capsule_radius) + 1
    column = len(chain.capsule_radius) - 1
    assert (chain.self_pairs == column).any()
    assert (chain.self_gap > 0).all()


ROLLING = """
<mujoco>
  <worldbody><body><geom size="0.05"/><body pos="0 0 0.5">
    <joint name="roll" axis="0 0 1" range="-170 170"/>
    <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
    <site name="camera" pos="0 0 0.1"/>
  </body></body></worldbody>
  <actuator><position joint="roll" kp="10"/></actuator>
</mujoco>
"""


def test_one_joint_along_the_view_can_only_roll(tmp_path):
    path = tmp_path / "roll.xml"
    path.write_text(ROLLING)
    chain = load_arm(str(path)).chain
    feasibility = Feasibility(chain, ClearanceField(Balls(), np.eye(4), 1.0), CONFIG)
    result = feasibility.probe(np.zeros(1), chain.camera_pose(np.zeros(1)) @ MOTIONS)
    np.testing.assert_array_equal(np.flatnonzero(result.ok), [0, 1, 2])  # none, right, left
    assert {REASONS[r] for r in result.reason[3:]} == {"unreachable"}
    np.testing.assert_allclose(np.abs(result.q[1:3, -1, 0]), np.radians(12), atol=2e-3)


# -- distances -------------------------------------------------------------------------------


@given(st.integers(0, 1000))
def test_distances_are_the_scenes_less_the_slack_where_it_is_flat(seed):
    world = _Below(0.3)
    clearance_field = ClearanceField(world, BASE, 1.4)
    points = np.random.default_rng(seed).uniform(-0.8, 0.8, (50, 3))
    true = world.clearance(transform_points(BASE, points))
    got = clearance_field.distance(points)
    assert (got <= true + 1e-6).all()
    flat = true > 0.1
    np.testing.assert_allclose(got[flat], true[flat] - clearance_field.slack_m, atol=1e-5)


def test_off_the_grid_nothing_is_free(furnished):
    far = np.array([[5.0, 0, 0], [0, 0, -4.0]])
    np.testing.assert_array_equal(furnished.distance(far), 0)


def test_a_scenes_own_grid_is_used_as_it_is():
    scene = _mesh_scene()
    T = make_pose(so3_exp([0, 0, 0.4]), [1.6, 1.6, 1.0])
    clearance_field = ClearanceField(scene, T, 1.4)
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (500, 3))
    expected = np.maximum(scene.clearance(transform_points(T, points)) - clearance_field.slack_m, 0)
    got = clearance_field.distance(points)
    assert (got >= expected - 1e-5).all()  # the slack is taken off before 0 is cut off
    np.testing.assert_allclose(got[expected > 0.1], expected[expected > 0.1], atol=1e-5)


def test_a_base_outside_the_scene_is_surrounded(box_scene):
    scene = _mesh_scene()
    outside = ClearanceField(scene, make_pose(np.eye(3), [50.0, 0, 0]), 0.8)
    np.testing.assert_array_equal(outside.distance(np.zeros((1, 3))), 0)


# -- inverse kinematics ----------------------------------------------------------------------


def test_inverse_kinematics_brings_the_camera_there(arm):
    rng = np.random.default_rng(0)
    q = arm.home + rng.uniform(-0.5, 0.5, 6)
    target = arm.chain.camera_pose(q)
    found = solve_pose(arm.chain, q + rng.uniform(-0.2, 0.2, (10, 6)), target)
    assert found.accurate().mean() > 0.7
    poses = arm.chain.camera_pose(found.q[found.accurate()])
    np.testing.assert_allclose(poses, np.broadcast_to(target, poses.shape), atol=1e-5)
    np.testing.assert_allclose(invert(target) @ poses[0], np.eye(4), atol=1e-5)


def test_inverse_kinematics_says_where_it_fails(arm):
    far = make_pose(np.eye(3), [3.0, 0, 0])
    found = solve_pose(arm.chain, arm.home[None], far)
    assert not found.accurate().any()
    assert found.error_m[0] > 1.5


class _Below:
    """Solid below a height."""

    def __init__(self, z):
        self.z = z

    def clearance(self, points):
        return np.maximum(points[:, 2] - self.z, 0)


def _lowest(arm, q):
    """Height of the lowest point of the moving links, and the slack of the grid of a test."""
    moving = arm.chain.capsule_link > 0
    ends = arm.chain.capsules(q)[moving]
    return float((ends[..., 2].min(axis=1) - arm.chain.capsule_radius[moving]).min()) - 0.025


def _mesh_scene():
    from ms_slam_env.sensor.scene_cache import get_scene

    return get_scene("wall", 1000)
