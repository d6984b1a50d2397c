"""ROS bags and MCAP files: what is read is what was sent, and every fault is named in a line."""

import dataclasses
import pickle
import re

import numpy as np
import pytest
from bag_files import COLOR, DEPTH, INFO, TRUTH, Messages, png, topics_of, write_bag

from ms_slam_env.camera import Distortion, Intrinsics, xtion
from ms_slam_env.camera.undistortion import undistort_color
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
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
    with pytest.raises(InputError, match="is no bag: it has no topics"):
        open_recording(tmp_path, intrinsics=Intrinsics(9, 9, 4, 4, 9, 9), topics=Topics("/a"))
