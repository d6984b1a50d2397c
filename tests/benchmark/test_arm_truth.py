"""The judge of collisions against closed forms."""

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from ms_slam_env.benchmark.arm_truth import FAR_M, ArmTruth, Furniture
from ms_slam_env.geometry import make_pose
from ms_slam_env.robot.arm import load_arm
from ms_slam_env.robot.arm.chain import segment_distance

CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)


@pytest.fixture(scope="module")
def furniture(box_scene):
    return Furniture(box_scene)


def floor_of(scene):
    return float(scene.mesh.vertices[:, 2].min())


def free_corner(scene, furniture):
    """A place above free floor, at least FAR_M from everything else."""
    points, _ = scene.surface_points(0.05)
    low, high = points.min(axis=0) + 0.5, points.max(axis=0) - 0.5
    rng = np.random.default_rng(0)
    while True:
        place = rng.uniform(low, high)
        column = np.tile(place, (20, 1))
        column[:, 2] = np.linspace(floor_of(scene) + 1.2 * FAR_M, high[2], 20)
        if furniture.distance(column).min() >= FAR_M:
            return place


def test_distance_to_the_floor(box_scene, furniture):
    place = free_corner(box_scene, furniture)
    for height in (0.001, 0.02, 0.05, 0.14):
        point = np.array([[place[0], place[1], floor_of(box_scene) + height]])
        assert_allclose(furniture.distance(point), height, atol=0.004 if height < 0.01 else 0.0007)


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
    for expected in (0.03, 0.1):
        base = [place[0], place[1], floor_of(box_scene) + below - 0.5 + expected]
        truth = ArmTruth(arm, furniture, make_pose(np.eye(3), base))
        hanging = np.array([[np.pi / 2]])
        assert_allclose(truth.gaps(hanging), expected, atol=0.0035)
    sunk = make_pose(np.eye(3), np.array(base) - [0, 0, expected + 0.01])
    assert ArmTruth(arm, furniture, sunk).gaps(hanging)[0] < 0


def test_self_contact_is_that_of_the_capsules():
    """All colliding geoms of the Mico but the camera are capsules: distances are closed form."""
    arm = load_arm("mico")
    truth = ArmTruth(arm, Furniture.__new__(Furniture), np.eye(4))
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


def test_column_is_touched_from_the_side():
    arm = load_arm("mico")
    truth = ArmTruth(arm, Furniture.__new__(Furniture), np.eye(4), column=(0.08, 0.7))
    without = ArmTruth(arm, Furniture.__new__(Furniture), np.eye(4))
    rng = np.random.default_rng(3)
    q = rng.uniform(arm.chain.lower, arm.chain.upper, (300, 6))
    only_column = truth.touches_itself(q) & ~without.touches_itself(q)
    assert only_column.any()
    ends, radius = arm.chain.capsules(q), arm.chain.capsule_radius
    column = np.array([[0, 0, -0.08], [0, 0, -0.7]])
    near = segment_distance(ends, column) < radius + 0.08
    near[:, arm.chain.capsule_link == 0] = False
    assert near.any(axis=1)[only_column].all()
