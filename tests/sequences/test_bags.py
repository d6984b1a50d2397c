"""ROS bags and MCAP files: what is read is what was sent, and every fault is named in a line."""

import dataclasses
import pickle
import re

import numpy as np
import pytest
from bag_files import COLOR, DEPTH, INFO, TRUTH, Messages, png, topics_of, write_bag

from ms_slam_env.camera import Distortion, Intrinsics, xtion
from ms_slam_env.camera.depth_registration import ColorCamera, Registration
from ms_slam_env.camera.undistortion import undistort_color
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.sequences import handheld_trajectory, open_sequence, render_sequence
from ms_slam_env.sequences.recording import Topics, open_recording

pytest.importorskip("rosbags")

K = xtion("80x60")
KINDS = {"ros1.bag": 1, "ros2": 2, "ros2.mcap": 2}


@pytest.fixture(scope="module")
def sequence(box_scene):
    poses = handheld_trajectory(box_scene, 5, 1, speed_m=0.04, rot_deg=2.0)
    times = 1_700_000_000.25 + np.arange(5) / 30  # as a clock has it
    return render_sequence(box_scene, poses, K, "kinect", 3, timestamps=times)


@pytest.fixture(scope="module")
def messages():
    return {version: Messages(version) for version in (1, 2)}


@pytest.fixture
def bag(tmp_path, sequence, messages):
    """Writes a ROS 1 bag with other topics in the place of some."""

    def write(**changes):
        (tmp_path / "one.bag").unlink(missing_ok=True)
        topics = {**topics_of(sequence, messages[1]), **changes}
        return write_bag(tmp_path / "one.bag", messages[1], {t: m for t, m in topics.items() if m})

    return write


@pytest.mark.parametrize("name", KINDS)
def test_what_is_read_is_what_was_sent(name, tmp_path, sequence, messages):
    own = messages[KINDS[name]]
    path = write_bag(tmp_path / name, own, topics_of(sequence, own), compressed=True)
    found = open_sequence(path)
    assert (found.frames.layout, len(found), found.has_color) == ("bag", 5, True)
    assert found.intrinsics == K
    np.testing.assert_allclose(found.timestamps, sequence.timestamps, atol=1e-6)
    np.testing.assert_allclose(found.poses, sequence.poses, atol=1e-9)
    for k in (3, 0, 4):  # in any order
        np.testing.assert_array_equal(found.frames[k].depth, sequence.frames[k].depth)
        np.testing.assert_array_equal(found.frames[k].color, sequence.frames[k].color)
    elsewhere = pickle.loads(pickle.dumps(found.frames))
    np.testing.assert_array_equal(elsewhere.frame(2).depth, sequence.frames[2].depth)


def test_the_command_runs_on_a_file(tmp_path, sequence, messages, capsys):
    path = write_bag(tmp_path / "ros2.mcap", messages[2], topics_of(sequence, messages[2]))
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 0
    assert float(re.search(r"ate_m +(\S+)", capsys.readouterr().out)[1]) < 0.01
    wrong = ["run", str(path), "--topics", "depth=/nowhere", "--out", str(tmp_path / "no")]
    assert main(wrong) == 2
    assert f"'/nowhere'; valid choices: {DEPTH}, {COLOR}" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


def test_compressed_images(bag, sequence, messages):
    own, times = messages[1], sequence.timestamps
    depth, color = sequence.frames[0].depth, sequence.frames[0].color
    whole = np.rint(depth * 1000).astype(np.uint16)
    header = bytes(12)
    path = bag(
        **{
            DEPTH: [],
            COLOR: [],
            "/camera/depth_registered/image/compressedDepth": [
                (times[0], own.compressed_depth(times[0], depth)),
                (
                    times[1],
                    own.compressed(times[1], header + png(whole), "16UC1; compressedDepth png"),
                ),
            ],
            "/camera/rgb/image/compressed": [
                (t, own.compressed(t, png(color), "bgr8; png compressed bgr8")) for t in times[:2]
            ],
        }
    )
    recording = open_recording(path)
    found, read = recording.frame(0).depth, depth > 0
    np.testing.assert_array_equal(found > 0, read)
    assert np.abs(1 / found[read] - 1 / depth[read]).max() < 1e-4
    np.testing.assert_array_equal(recording.frame(1).depth, whole / np.float32(1000))
    for frame in recording:
        np.testing.assert_array_equal(frame.color, color)


@pytest.mark.parametrize("encoding", ["rgb8", "rgba8", "bgra8", "mono8"])
def test_encodings_of_colour(encoding, bag, sequence, messages):
    time, color = sequence.timestamps[0], sequence.frames[0].color
    order = {"r": [0, 1, 2, 0], "b": [2, 1, 0, 0], "m": [1]}[encoding[0]][: len(encoding) - 1]
    sent = np.ascontiguousarray(color[..., order if encoding != "mono8" else [1]])
    wanted = color if encoding != "mono8" else np.repeat(color[..., 1:2], 3, axis=2)
    step = sent.shape[1] * sent.shape[2]
    image = messages[1].image(time, sent, encoding, step=step)
    path = bag(**{COLOR: [(time, image)]})
    np.testing.assert_array_equal(open_recording(path).frame(0).color, wanted)


def test_whole_millimetres_big_endian_with_padded_rows(bag, sequence, messages):
    time, depth = sequence.timestamps[0], sequence.frames[0].depth
    whole = np.rint(depth * 1000).astype(">u2")
    padded = np.hstack([whole.view(np.uint8), np.full((60, 8), 255, np.uint8)])
    image = messages[1].image(time, padded, "16UC1", width=80, is_bigendian=1)
    path = bag(**{DEPTH: [(time, image)]})
    np.testing.assert_array_equal(open_recording(path).frame(0).depth, whole / np.float32(1000))
    given = open_recording(path, intrinsics=K)  # without a scale, as the encoding says
    np.testing.assert_array_equal(given.frame(0).depth, whole / np.float32(1000))


@pytest.mark.parametrize("kind", ["Odometry", "TransformStamped", "PoseWithCovarianceStamped"])
@pytest.mark.parametrize("version", [1, 2])
def test_types_of_pose(kind, version, tmp_path, sequence, messages):
    own = messages[version]
    topics = topics_of(sequence, own)
    topics["/odom"] = [
        (t, own.pose(t, T, kind)) for t, T in zip(sequence.timestamps, sequence.poses, strict=True)
    ]
    del topics[TRUTH]
    path = write_bag(tmp_path / ("a.bag" if version == 1 else "a"), own, topics)
    assert open_recording(path).truth is None  # an estimate is no truth unless it is said to be
    found = open_recording(path, topics=Topics(pose="/odom"))
    np.testing.assert_allclose(found.truth, sequence.poses, atol=1e-9)


def test_a_lens_is_straightened_unless_the_images_are(bag, sequence, messages):
    lens = Distortion.of("plumb_bob", [-0.2, 0.05, 0.001, 0.002, 0.0])
    bent = dataclasses.replace(K, distortion=lens)
    info = [(sequence.timestamps[0], messages[1].info(sequence.timestamps[0], bent))]
    recording = open_recording(bag(**{INFO: info}))
    assert (recording.source, recording.intrinsics) == (bent, K)
    straight = undistort_color(sequence.frames[1].color, bent)
    np.testing.assert_array_equal(recording.frame(1).color, straight)


def test_rectified_images_have_no_lens(tmp_path, sequence, messages):
    own, times = messages[1], sequence.timestamps
    bent = dataclasses.replace(K, distortion=Distortion.of("plumb_bob", [-0.2, 0.05]))
    topics = {"/c/depth/image_rect": topics_of(sequence, own)[DEPTH]}
    topics["/c/depth/camera_info"] = [(times[0], own.info(times[0], bent))]
    recording = open_recording(write_bag(tmp_path / "a.bag", own, topics))
    assert recording.source == K
    assert not recording.has_color


def test_messages_out_of_order_and_sent_twice(bag, sequence, messages):
    sent = topics_of(sequence, messages[1])[DEPTH]
    late = [(t + 1.0 - 2 * k / 30, m) for k, (t, m) in enumerate(sent)]
    recording = open_recording(bag(**{DEPTH: [*late, (late[0][0], sent[0][1])]}))
    np.testing.assert_allclose(recording.timestamps, sequence.timestamps, atol=1e-6)
    np.testing.assert_array_equal(recording.frame(1).depth, sequence.frames[1].depth)


COLOR_INFO, OF_DEPTH, OF_COLOR = "/camera/rgb/camera_info", "depth_optical", "rgb_optical"
T_DEPTH_COLOR = make_pose(so3_exp([0.01, 0.02, -0.01]), [0.025, 0.002, 0.001])


def of_frame(sent, frame):
    """The same messages of another frame."""
    return [
        (t, dataclasses.replace(m, header=dataclasses.replace(m.header, frame_id=frame)))
        for t, m in sent
    ]


@pytest.fixture
def unregistered(sequence, messages):
    """Topics of a colour camera of its own, beside the depth camera and of another focal length."""
    own, time = messages[1], sequence.timestamps[0]
    topics = topics_of(sequence, own)
    K_color = Intrinsics(100, 101, 41, 29, 80, 60)
    v, u = np.mgrid[:60, :80]
    ramp = np.stack([3 * u, 4 * v, 0 * u], axis=-1).astype(np.uint8)
    images = [(t, own.image(t, ramp, "rgb8", step=240)) for t in sequence.timestamps]
    links = {("base", OF_DEPTH): make_pose(np.eye(3), [0, 0, 1])}
    links[("base", OF_COLOR)] = links[("base", OF_DEPTH)] @ T_DEPTH_COLOR
    return {
        DEPTH: of_frame(topics[DEPTH], f"/{OF_DEPTH}"),
        COLOR: of_frame(images, OF_COLOR),
        COLOR_INFO: [(time, own.info(time, K_color))],
        "/tf_static": [(time, own.transforms(time, links))],
    }, K_color


def test_colour_of_another_camera_is_registered_by_its_transform(bag, sequence, unregistered):
    topics, K_color = unregistered
    path = bag(**topics)
    with pytest.warns(InputWarning, match="depth is not registered: colour of 80x60, focal length"):
        recording = open_recording(path)
    depth = sequence.frames[2].depth
    points = K.rays()[depth > 0] * depth[depth > 0][:, None]
    T = np.linalg.inv(T_DEPTH_COLOR)
    want = K_color.project(points @ T[:3, :3].T + T[:3, 3])
    inside = ((want >= 0) & (want <= [79, 59])).all(axis=1)
    found = recording.frame(2).color[depth > 0][inside, :2]
    assert inside.sum() > 1000
    np.testing.assert_allclose(found, want[inside] * [3, 4], atol=1)
    plain = open_recording(path, register=False)
    assert plain.registration is None
    np.testing.assert_array_equal(plain.frame(2).color[5, 7], [21, 20, 0])
    assert open_recording(path, register=True).registration == Registration()


def test_cameras_whose_place_nobody_says_are_refused(bag, unregistered):
    topics, _ = unregistered
    no_place = "depth is of frame depth_optical and colour of rgb_optical, and no /tf_static"
    with pytest.raises(InputError, match=no_place):
        open_recording(bag(**{**topics, "/tf_static": []}))
    with pytest.raises(InputError, match="colour is of another camera, rgb_optical, whose Cam"):
        open_recording(bag(**{**topics, COLOR_INFO: []}))


def test_colour_of_one_frame_and_another_calibration_is_registered(bag, sequence, messages):
    time = sequence.timestamps[0]
    K_color = dataclasses.replace(K, fx=1.5 * K.fx, fy=1.5 * K.fy)
    with pytest.warns(InputWarning, match="depth is not registered"):
        found = open_recording(bag(**{COLOR_INFO: [(time, messages[1].info(time, K_color))]}))
    assert found.registration == ColorCamera(K_color, np.eye(4))
    same = open_recording(bag(**{COLOR_INFO: [(time, messages[1].info(time, K))]}))
    assert same.registration is None


def test_poses_of_another_body_are_moved_to_the_camera_or_warned_of(bag, sequence, messages):
    own, time = messages[1], sequence.timestamps[0]
    T_body_camera = make_pose(so3_exp([0.5, -1.0, 0.3]), [0.3, -0.1, 0.2])
    bodies = sequence.poses @ np.linalg.inv(T_body_camera)
    sent = [
        (t, dataclasses.replace(own.pose(t, T, "Odometry"), child_frame_id="/base_link"))
        for t, T in zip(sequence.timestamps, bodies, strict=True)
    ]
    link = own.transforms(time, {("base_link", "camera"): T_body_camera})
    found = open_recording(bag(**{TRUTH: sent, "/tf_static": [(time, link)]}))
    np.testing.assert_allclose(found.truth, sequence.poses, atol=1e-9)
    with pytest.warns(InputWarning, match="are of frame base_link, images of camera, and no /tf"):
        found = open_recording(bag(**{TRUTH: sent}))
    np.testing.assert_allclose(found.truth, bodies, atol=1e-9)


def test_topics_of_poses_that_are_not_taken_are_named(bag, sequence, messages):
    topics = topics_of(sequence, messages[1])
    with pytest.warns(InputWarning, match=r"no poses are taken as true; .*'/odom'"):
        assert open_recording(bag(**{TRUTH: [], "/odom": topics[TRUTH]})).truth is None


def test_a_clock_that_begins_at_zero(tmp_path, sequence, messages):
    own = messages[1]
    frames = zip(np.arange(3) / 10, sequence.frames, strict=False)
    sent = [(1.7e9 + t, own.image(t, f.depth, "32FC1")) for t, f in frames]
    topics = {DEPTH: sent, INFO: [(1.7e9, own.info(0.0, K))]}
    recording = open_recording(write_bag(tmp_path / "a.bag", own, topics))
    np.testing.assert_allclose(recording.timestamps, [0, 0.1, 0.2], atol=1e-9)


@pytest.mark.parametrize("form", ["16UC1; compressedDepth", "16UC1; compressedDepth "])
@pytest.mark.parametrize("header", [b"", bytes(12)])
def test_compressed_depth_of_before_its_codec_was_named(form, header, bag, sequence, messages):
    time = sequence.timestamps[0]
    whole = np.rint(sequence.frames[0].depth * 1000).astype(np.uint16)
    whole[3, 4] = 65535
    sent = messages[1].compressed(time, header + png(whole), form)
    topic = "/camera/depth/image/compressedDepth"
    depth = open_recording(bag(**{DEPTH: [], topic: [(time, sent)]})).frame(0).depth
    whole[3, 4] = 0
    np.testing.assert_array_equal(depth, whole / np.float32(1000))


@pytest.mark.parametrize("profile", ["ros1", ""])
def test_mcap_of_another_profile_is_named(profile, tmp_path, sequence, messages):
    path = write_bag(tmp_path / "a.mcap", messages[2], topics_of(sequence, messages[2]))
    data = path.read_bytes()
    assert data[17:25] == b"\4\0\0\0ros2"
    path.write_bytes(data[:17] + bytes([len(profile), 0, 0, 0]) + profile.encode() + data[25:])
    with pytest.raises(InputError, match=f"MCAP file of profile '{profile}'; only ros2 is read"):
        open_recording(path)


def test_a_rational_lens(bag, sequence, messages):
    time, numbers = sequence.timestamps[0], [0.5, -2.6, 1e-4, -2e-4, 1.5, 0.4, -2.4, 1.4]
    info = messages[1].info(time, K)
    info = dataclasses.replace(info, D=np.array(numbers), distortion_model="rational_polynomial")
    recording = open_recording(bag(**{INFO: [(time, info)]}))
    assert recording.source.distortion == Distortion.of("rational", numbers)
    straight = undistort_color(sequence.frames[1].color, recording.source)
    np.testing.assert_array_equal(recording.frame(1).color, straight)


def broken(what, sequence, own):
    """Topics with one fault, and what is said of it."""
    time, frame = sequence.timestamps[0], sequence.frames[0]
    image = own.image(time, frame.depth, "32FC1")
    cut = dataclasses.replace(image, data=image.data[:-100])
    small = own.image(time, frame.depth[::2, ::2].copy(), "32FC1")
    odd = dataclasses.replace(image, encoding="8UC1")
    zero = own.pose(time, sequence.poses[0])
    turn = type(zero.pose.orientation)(0.0, 0.0, 0.0, 0.0)
    zero = dataclasses.replace(zero, pose=dataclasses.replace(zero.pose, orientation=turn))
    rvl = own.compressed(time, bytes(40), "16UC1; compressedDepth rvl")
    sent = topics_of(sequence, own)[DEPTH]
    return {
        "no depth": ({DEPTH: []}, "has no topic of depth images: .*rgb/image_color"),
        "two": ({"/b/depth/image": sent}, "which topic is depth.*'/b/depth/image', '/camera/depth"),
        "no info": ({INFO: []}, "calibration of /camera/depth/image is missing: there is no /cam"),
        "cut": ({DEPTH: [(time, cut)]}, "an image is cut off: 19100 bytes"),
        "size": ({DEPTH: [(time, small)]}, f"{DEPTH} is 40x30 but the intrinsics say 80x60"),
        "encoding": (
            {DEPTH: [(time, odd)]},
            "encoding of depth in .* '8UC1'; valid choices: 16UC1",
        ),
        "format": ({DEPTH: [(time, rvl)]}, "format of depth .* valid choices: 16UC1; compressedD"),
        "quaternion": ({TRUTH: [(time, zero)]}, "ground_truth/pose has no unit quaternion"),
        "colour of another day": (
            {COLOR: [(time, own.image(time + 9, frame.color, "rgb8", step=240))]},
            "no image of /camera/rgb/image_color is as old as one of /camera/depth",
        ),
    }[what]


@pytest.mark.parametrize(
    "what",
    ["no depth", "two", "no info", "cut", "size", "encoding", "format", "quaternion",
     "colour of another day"],
)  # fmt: skip
def test_faults_are_named(what, bag, sequence, messages):
    changes, complaint = broken(what, sequence, messages[1])
    with pytest.raises(InputError, match=complaint) as error:
        open_recording(bag(**changes)).frame(0)
    assert "\n" not in str(error.value)


def test_files_that_are_no_bags(tmp_path, bag):
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"nothing of the kind" * 100)
        with pytest.raises(InputError, match=rf"cannot read .*{name}"):
            open_recording(tmp_path / name)
    with pytest.raises(InputError, match=r"neither a folder nor scene.* nor a bag"):
        open_sequence(tmp_path / "missing.mcap")
    path = bag()
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(InputError, match="cannot read"):
        open_recording(path)
    (tmp_path / "depth").mkdir()
    with pytest.raises(InputError, match="is not a bag: it has no topics"):
        open_recording(tmp_path, intrinsics=Intrinsics(9, 9, 4, 4, 9, 9), topics=Topics("/a"))
