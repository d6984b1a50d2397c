"""The judge of collisions against closed forms."""

import mujoco
import numpy as np
import pytest
from ms_slam_experiments.arm_masks import (
    ArmTruth,
    Cloud,
    column_cloud,
    furniture_cloud,
    signed_distance,
)
from numpy.testing import assert_allclose

from ms_slam_env.geometry import make_pose
from ms_slam_env.robot.arm import load_arm
from ms_slam_env.robot.arm.chain import segment_distance

CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
NOWHERE = Cloud(np.full((1, 3), 1e3))


@pytest.fixture(scope="module")
def furniture(box_scene):
    return furniture_cloud(box_scene, spacing_m=0.01)


def floor_of(scene):
    return float(scene.mesh.vertices[:, 2].min())


def free_corner(scene, furniture):
    """A place above free floor, far from everything else."""
    points, _ = scene.surface_points(0.05)
    low, high = points.min(axis=0) + 0.5, points.max(axis=0) - 0.5
    rng = np.random.default_rng(0)
    while True:
        place = rng.uniform(low, high)
        above = np.tile(place, (20, 1))
        above[:, 2] = np.linspace(floor_of(scene) + 0.3, high[2], 20)
        if furniture.at_least(above).min() > 0.2:
            return place


def test_cloud_finds_what_is_near():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (3000, 3))
    cloud = Cloud(points)
    places = rng.uniform(-1.5, 1.5, (50, 3))
    distance = np.linalg.norm(points - places[:, None], axis=2)
    bound = cloud.at_least(places)
    assert (bound <= distance.min(axis=1)).all()
    assert (bound > distance.min(axis=1) - 0.08).all()
    for place, row in zip(places, distance, strict=True):
        near = cloud.around(place, 0.3)
        assert len(near) == (row <= 0.3).sum()
        assert (np.linalg.norm(near - place, axis=1) <= 0.3).all()


ONE_LINK = """<mujoco><worldbody><body name="b" pos="0 0 0.5">
  <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="j" axis="0 1 0"/>
  {geom}<site name="camera" pos="0.3 0 0"/></body></worldbody>
  <actuator><position joint="j" kp="5"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("geom", "below"),
    [
        ('<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.04"/>', 0.3 + 0.04),
        ('<geom type="sphere" pos="0.3 0 0" size="0.05"/>', 0.3 + 0.05),
        ('<geom type="box" pos="0.2 0 0" size="0.1 0.02 0.03"/>', 0.3),
        ('<geom type="cylinder" fromto="0.1 0 0 0.28 0 0" size="0.03"/>', 0.28),
        ('<geom type="ellipsoid" pos="0.2 0 0" size="0.1 0.02 0.03"/>', 0.3),
    ],
)
def test_gap_of_a_link_that_hangs_over_the_floor(box_scene, furniture, tmp_path, geom, below):
    path = tmp_path / "arm.xml"
    path.write_text(ONE_LINK.format(geom=geom))
    arm = load_arm(str(path))
    place = free_corner(box_scene, furniture)
    for expected in (0.02, 0.09):
        base = [place[0], place[1], floor_of(box_scene) + below - 0.5 + expected]
        truth = ArmTruth(arm, furniture, make_pose(np.eye(3), base))
        hanging = np.array([[np.pi / 2]])
        [gap] = truth.gaps(hanging)
        assert gap == pytest.approx(expected, abs=0.002) or ("ellipsoid" in geom and gap > 0)
    sunk = make_pose(np.eye(3), np.array(base) - [0, 0, expected + 0.01])
    assert ArmTruth(arm, furniture, sunk).gaps(hanging)[0] < 0


def test_self_contact_is_that_of_the_capsules():
    """All colliding geoms of the Mico but the camera are capsules: distances are closed form."""
    arm = load_arm("mico")
    truth = ArmTruth(arm, NOWHERE, np.eye(4))
    rng = np.random.default_rng(2)
    q = rng.uniform(arm.chain.lower, arm.chain.upper, (300, 6))
    found = truth.touches_itself(q)
    mj = arm.mj
    geoms = np.flatnonzero(mj.geom_contype)
    excluded = {int(s) for s in mj.exclude_signature}
    body = mj.geom_bodyid[geoms]
    expected = np.zeros(len(q), dtype=bool)
    unsure = np.zeros(len(q), dtype=bool)
    ends, radius = arm.chain.capsules(q), arm.chain.capsule_radius
    for i in range(len(geoms)):
        for j in range(i):
            a, b = sorted((int(body[i]), int(body[j])))
            if (
                mj.body_weldid[a] == mj.body_weldid[b]
                or (mj.body_parentid[b] == a and mj.body_weldid[a] != 0)
                or (a << 16) + b in excluded
            ):
                continue
            near = segment_distance(ends[:, i], ends[:, j]) < radius[i] + radius[j]
            if {int(mj.geom_type[geoms[k]]) for k in (i, j)} == {CAPSULE}:
                expected |= near
            else:
                unsure |= near  # a bounding capsule is larger than what it holds
    assert expected.sum() > 5
    assert found[expected].all()
    assert not found[~expected & ~unsure].any()


SHAPES = {"sphere": "0.05", "capsule": "0.03 0.1", "cylinder": "0.04 0.07", "box": "0.05 0.02 0.08"}


@pytest.mark.parametrize("kind", SHAPES)
def test_signed_distance_is_mujocos(kind):
    """MuJoCo measures from a tiny ball."""
    mj = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><geom type="{kind}" size="{SHAPES[kind]}"/>
        <body name="probe" mocap="true"><geom type="sphere" size="1e-4"/></body>
        </worldbody></mujoco>"""
    )
    data = mujoco.MjData(mj)
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.2, 0.2, (200, 3))
    found = signed_distance(mj, 0, points)
    expected = np.empty(len(points))
    for i, point in enumerate(points):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(mj, data)
        expected[i] = mujoco.mj_geomDistance(mj, data, 0, 1, 1.0, None) + 1e-4
    outside = found > 0.001
    assert outside.sum() > 100
    assert_allclose(found[outside], expected[outside], atol=1e-5)
    assert (expected[~outside] < 0.0012).all()


def test_column_is_touched_from_the_side():
    arm = load_arm("mico")
    truth = ArmTruth(arm, NOWHERE, np.eye(4), column_cloud(0.08, 0.7))
    without = ArmTruth(arm, NOWHERE, np.eye(4))
    rng = np.random.default_rng(3)
    q = rng.uniform(arm.chain.lower, arm.chain.upper, (200, 6))
    only_column = truth.touches_itself(q) & ~without.touches_itself(q)
    assert only_column.any()
    ends, radius = arm.chain.capsules(q), arm.chain.capsule_radius
    column = np.array([[0, 0, -0.08], [0, 0, -0.7]])
    gap = segment_distance(ends, column) - radius - 0.08
    gap[:, arm.chain.capsule_link == 0] = 1
    assert (gap.min(axis=1)[only_column] < 0).all()
    capsule = np.flatnonzero(arm.mj.geom_contype)
    round_only = arm.mj.geom_type[capsule] == CAPSULE
    surely = gap[:, round_only].min(axis=1) < -0.001
    assert truth.touches_itself(q)[surely].all()


def test_an_arm_that_folds_back_sees_itself():
    arm = load_arm("mico")
    truth = ArmTruth(arm, NOWHERE, np.eye(4))
    straight = np.array([[0.0, 0.0, 1.0]])
    assert not truth.sees_itself(arm.home, straight)
    rng = np.random.default_rng(4)
    q = rng.uniform(arm.chain.lower, arm.chain.upper, (300, 6))
    found = np.array([truth.sees_itself(one, straight) for one in q])
    poses = arm.chain.camera_pose(q)
    ray = np.stack([poses[:, :3, 3], poses[:, :3, 3] + 2 * poses[:, :3, 2]], axis=1)
    near = segment_distance(ray[:, None], arm.chain.capsules(q)) < arm.chain.capsule_radius
    body = arm.mj.geom_bodyid[np.flatnonzero(arm.mj.geom_contype)]
    near[:, body == arm.mj.body("camera_body").id] = False
    hand = np.isin(body, [arm.mj.body("hand").id])
    near[:, hand] = False  # behind the camera
    capsules = arm.mj.geom_type[np.flatnonzero(arm.mj.geom_contype)] == CAPSULE
    assert found[near[:, capsules].any(axis=1)].all()
    assert found.any()
