"""What is read from any arm's MJCF, and the geometry of its chain, against slow or other truth."""

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import so3_log
from ms_slam_env.robot.arm import ArmModel, load_arm
from ms_slam_env.robot.arm.chain import segment_distance

SECOND_ARM = Path(__file__).with_name("second_arm.xml")
ARMS = {"mico": ("mico", "camera"), "second": (str(SECOND_ARM), "lens")}


@pytest.fixture(params=ARMS, scope="module")
def arm(request) -> ArmModel:
    return load_arm(*ARMS[request.param])


def postures(arm, count):
    rng = np.random.default_rng(1)
    return rng.uniform(arm.chain.lower, arm.chain.upper, (count, arm.chain.num_joints))


def place(arm, q):
    data = mujoco.MjData(arm.mj)
    data.qpos[arm.qpos] = q
    mujoco.mj_forward(arm.mj, data)
    return data


def test_chain_puts_the_camera_where_mujoco_does(arm):
    q = postures(arm, 50)
    poses = arm.chain.camera_pose(q)
    for one, pose in zip(q, poses, strict=True):
        data = place(arm, one)
        assert_allclose(pose[:3, 3], data.site_xpos[arm.camera_site], atol=1e-9)
        assert_allclose(pose[:3, :3], data.site_xmat[arm.camera_site].reshape(3, 3), atol=1e-9)


def test_jacobian_is_mujocos(arm):
    for q in postures(arm, 20):
        linear, angular = np.zeros((3, arm.mj.nv)), np.zeros((3, arm.mj.nv))
        mujoco.mj_jacSite(arm.mj, place(arm, q), linear, angular, arm.camera_site)
        expected = np.concatenate([linear, angular])[:, arm.dof]
        assert_allclose(arm.chain.camera_jacobian(q), expected, atol=1e-9)


def test_jacobian_is_the_slope_of_the_pose(arm):
    h = 1e-6
    for q in postures(arm, 5):
        slope = np.zeros((6, arm.chain.num_joints))
        for i in range(arm.chain.num_joints):
            step = h * np.eye(arm.chain.num_joints)[i]
            before, after = arm.chain.camera_pose(np.stack([q - step, q + step]))
            slope[:3, i] = (after[:3, 3] - before[:3, 3]) / (2 * h)
            slope[3:, i] = so3_log(after[:3, :3] @ before[:3, :3].T) / (2 * h)
        assert_allclose(arm.chain.camera_jacobian(q), slope, atol=1e-7)


def test_batches_of_postures_equal_one_by_one(arm):
    q = postures(arm, 6).reshape(2, 3, -1)
    chain = arm.chain
    for batched, single in (
        (chain.link_poses(q), chain.link_poses),
        (chain.capsules(q), chain.capsules),
    ):
        for i, j in np.ndindex(2, 3):
            assert_allclose(batched[i, j], single(q[i, j]), atol=1e-12)


def surface_samples(arm, geom):
    """Points on (or within a millimetre outside) the surface of a geom, in its frame."""
    kind, size = arm.mj.geom_type[geom], arm.mj.geom_size[geom]
    rng = np.random.default_rng(geom)
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_SPHERE:
        return size[0] * directions
    if kind == types.mjGEOM_ELLIPSOID:
        return size * directions
    if kind == types.mjGEOM_CAPSULE:
        return size[0] * directions + np.sign(directions[:, 2:]) * [0, 0, size[1]]
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).T.reshape(-1, 3)
    if kind == types.mjGEOM_BOX:
        inside = rng.uniform(-1, 1, (500, 3))
        inside /= np.abs(inside).max(axis=1, keepdims=True)
        return size * np.concatenate([corners, inside])
    assert kind == types.mjGEOM_CYLINDER
    angle = rng.uniform(0, 2 * np.pi, 500)
    height = np.concatenate([[-1] * 100, [1] * 100, rng.uniform(-1, 1, 300)]) * size[1]
    return np.stack([size[0] * np.cos(angle), size[0] * np.sin(angle), height], axis=1)


def test_every_capsule_contains_its_geom(arm):
    colliding = [g for g in range(arm.mj.ngeom) if arm.mj.geom_contype[g]]
    assert len(colliding) == len(arm.chain.capsule_link)
    for q in postures(arm, 3):
        data, ends = place(arm, q), arm.chain.capsules(q)
        for capsule, geom in enumerate(colliding):
            points = surface_samples(arm, geom) @ data.geom_xmat[geom].reshape(3, 3).T
            points += data.geom_xpos[geom]
            axis = np.broadcast_to(ends[capsule], (len(points), 2, 3))
            distance = segment_distance(np.repeat(points[:, None], 2, axis=1), axis)
            assert distance.max() <= arm.chain.capsule_radius[capsule] + 1e-9
            assert distance.max() > 0.5 * arm.chain.capsule_radius[capsule]  # no balloon


def test_links_are_numbered_from_the_base(arm):
    """Moving joint ``i`` moves the capsules of the links after it, and no other."""
    still = arm.chain.capsules(arm.home)
    for i in range(arm.chain.num_joints):
        q = arm.home.copy()
        q[i] += 0.3
        moved = np.abs(arm.chain.capsules(q) - still).max(axis=(1, 2)) > 1e-9
        assert not moved[arm.chain.capsule_link <= i].any()
        assert moved[arm.chain.capsule_link > i].any()


def test_pairs_that_must_stay_apart_are_apart_at_home(arm):
    first, second = arm.chain.self_pairs.T
    assert len(first) > 0
    ends, radius = arm.chain.capsules(arm.home), arm.chain.capsule_radius
    assert (segment_distance(ends[first], ends[second]) > radius[first] + radius[second]).all()
    assert (np.abs(arm.chain.capsule_link[first] - arm.chain.capsule_link[second]) > 1).all()


def test_limits(arm):
    chain = arm.chain
    assert chain.within_limits(arm.home)
    q = np.stack([arm.home] * 3)
    q[1, 1] = chain.upper[1] + 1e-6
    q[2, 1] = chain.upper[1] - 0.01
    assert chain.within_limits(q).tolist() == [True, False, True]
    assert chain.within_limits(q, margin_rad=0.02).tolist() == [True, False, False]


def test_second_arm_is_read_as_written():
    arm = load_arm(*ARMS["second"], joint_speed_rad_s=0.7)
    assert arm.chain.num_joints == 7
    assert_allclose(arm.chain.speed, 0.7)  # it states none of its own
    assert_allclose(np.degrees(arm.chain.upper), [170, 110, 170, 150, 170, 115, 170])
    expected = np.eye(4)
    expected[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # level, looking along the base's x
    expected[:3, 3] = [0.4690, 0, 0.6031]
    assert_allclose(arm.chain.camera_pose(arm.home), expected, atol=1e-4)
    assert [arm.mj.actuator(int(a)).trnid[0] for a in arm.actuators] == list(range(7))


coordinate = st.floats(-1, 1, allow_subnormal=False)
point = st.tuples(coordinate, coordinate, coordinate)
segment = st.one_of(st.tuples(point, point), point.map(lambda p: (p, p)))


@given(segment, segment)
def test_segment_distance_is_the_minimum(a, b):
    a, b = np.array(a), np.array(b)
    lengths = np.array([np.linalg.norm(a[1] - a[0]), np.linalg.norm(b[1] - b[0])])
    assume(((lengths == 0) | (lengths > 1e-3)).all())

    def squared(st_):
        gap = a[0] + st_[0] * (a[1] - a[0]) - b[0] - st_[1] * (b[1] - b[0])
        return float(gap @ gap)

    starts = [(0, 0), (1, 1)]  # the problem is convex
    found = [minimize(squared, x0, bounds=[(0, 1)] * 2, tol=1e-14) for x0 in starts]
    best = np.sqrt(min(result.fun for result in found))
    # Segments parallel to 1e-6 count as parallel.
    assert_allclose(segment_distance(a, b), best, atol=2e-5)
    assert_allclose(segment_distance(b, a), segment_distance(a, b), atol=1e-5)


def test_segment_distance_of_parallel_touching_and_crossing_segments():
    one = np.array([[0, 0, 0], [1, 0, 0]], dtype=float)
    others = np.array(
        [
            [[0, 1, 0], [1, 1, 0]],
            [[3, 0, 0], [5, 0, 0]],
            [[0.5, -1, 0], [0.5, 1, 0]],
            [[0.5, -1, 0.2], [0.5, 1, 0.2]],
            [[0.7, 0.3, 0], [0.7, 0.3, 0]],
        ]
    )
    assert_allclose(segment_distance(one, others), [1, 2, 0, 0.2, 0.3], atol=1e-12)


HEAD = "<mujoco><worldbody><body name='b'><inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>"
TAIL = "<site name='camera'/></body></worldbody>{}</mujoco>"
ACTUATOR = "<actuator><position joint='j' kp='5'/></actuator>"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("no XML at all", "MuJoCo cannot read it"),
        ("<mujoco><nonsense/></mujoco>", "MuJoCo cannot read it"),
        (HEAD + TAIL.format(""), "no joint moves the camera's site"),
        (
            HEAD + "<joint name='j' type='slide'/>" + TAIL.format(ACTUATOR),
            "joint 'j' on the way to the camera is not a hinge",
        ),
        (
            HEAD + "<joint name='j'/><joint name='k' axis='1 0 0'/>" + TAIL.format(ACTUATOR),
            "body 'b' has 2 joints, not one",
        ),
        (
            HEAD + "<joint name='j'/>" + TAIL.format(""),
            "joint 'j' needs one position actuator, it has 0",
        ),
        (
            HEAD + "<joint name='j'/>" + TAIL.format("<actuator><motor joint='j'/></actuator>"),
            "joint 'j' needs one position actuator, it has 0",
        ),
        (
            HEAD
            + "<joint name='j'/>"
            + TAIL.format(ACTUATOR + "<custom><numeric name='joint_speed' data='1 2'/></custom>"),
            "joint_speed must be 1 numbers above 0",
        ),
        (
            HEAD
            + "<joint name='j'/>"
            + TAIL.format(ACTUATOR + "<custom><numeric name='joint_speed' data='-1'/></custom>"),
            "joint_speed must be 1 numbers above 0",
        ),
    ],
)
def test_bad_file_is_one_clear_error(tmp_path, content, reason):
    path = tmp_path / "arm.xml"
    path.write_text(content)
    with pytest.raises(InputError) as caught:
        load_arm(str(path))
    message = str(caught.value)
    assert reason in message
    assert str(path) in message
    assert "\n" not in message


_ASSETS = {
    "include": "<include file='part'/>",
    "mesh": "<asset><mesh file='part'/></asset>",
    "in a folder": "<compiler meshdir='inner'/><asset><mesh file='../part'/></asset>",
    "behind a comment": '<!-- file=" --><asset><mesh file="part"/></asset>',
    "of one side, escaped": "<asset><texture type='cube' fileright = \"&#112;art\"/></asset>",
    "within an include": "<include file='more.xml'/>",
}


@pytest.mark.parametrize("kind", ["pipe", "device", "large"])
@pytest.mark.parametrize("asset", _ASSETS)
def test_what_a_model_names_is_a_regular_file_of_bounded_size(tmp_path, kind, asset):
    """MuJoCo would read a pipe for ever."""
    (tmp_path / "inner").mkdir()
    (tmp_path / "more.xml").write_text("<mujoco><asset><hfield file='part'/></asset></mujoco>")
    (tmp_path / "arm.xml").write_text(f"<mujoco>{_ASSETS[asset]}</mujoco>")
    if kind == "pipe":
        os.mkfifo(tmp_path / "part")
    elif kind == "device":
        (tmp_path / "part").symlink_to("/dev/zero")
    else:
        with (tmp_path / "part").open("wb") as file:
            file.truncate(2**31 + 1)
    with pytest.raises(InputError, match=r"file of arm .*arm\.xml, .*part: (not a reg|larger)"):
        load_arm(str(tmp_path / "arm.xml"))


def test_a_model_may_include_itself_and_be_refused(tmp_path):
    (tmp_path / "arm.xml").write_text("<mujoco><include file='arm.xml'/></mujoco>")
    with pytest.raises(InputError, match="MuJoCo cannot read it"):
        load_arm(str(tmp_path / "arm.xml"))


def test_missing_file_lists_the_arms():
    with pytest.raises(InputError, match=r"arm.model 'mica': no such file; valid choices: mico"):
        load_arm("mica")


def test_missing_camera_site_lists_the_sites():
    with pytest.raises(InputError, match=r"no site named 'camera'; its sites: lens, mark; set"):
        load_arm(str(SECOND_ARM))
