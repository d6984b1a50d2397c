"""EuRoC and KITTI odometry: rectification, depth of stereo and poses against what was rendered."""

import re
import shutil

import cv2
import numpy as np
import pytest
from PIL import Image
from stereo_files import LENSES, T_LEFT_RIGHT, write_euroc, write_kitti

from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.geometry import invert, look_at
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences import open_sequence
from ms_slam_env.sequences.recording import open_recording
from ms_slam_env.sequences.recording.stereo import StereoRig

K = xtion("320x240")
POSES = np.stack([look_at([-1.4 + 0.02 * k, -1.4, 1.3], [0.9, 0.6, 0.7]) for k in range(3)])


@pytest.fixture(scope="module")
def euroc(box_scene, tmp_path_factory):
    return write_euroc(tmp_path_factory.mktemp("euroc") / "V1_01_easy", box_scene, K, POSES)


@pytest.fixture(scope="module")
def kitti(box_scene, tmp_path_factory):
    return write_kitti(tmp_path_factory.mktemp("kitti") / "00", box_scene, K, POSES)


def check_frames(recording, scene):
    """Depth and colour of every frame are those of a camera at its true pose."""
    sensor = RGBDSensor(scene, recording.intrinsics, noise="none")
    for frame, T in zip(recording, recording.truth, strict=True):
        true = sensor.ground_truth(T)
        found = frame.depth > 0
        assert found.mean() > 0.5
        disparity = K.fx * 0.11 * np.abs(1 / frame.depth[found] - 1 / true.depth[found])
        assert np.median(disparity) < 0.2  # pixels
        assert (disparity > 1.0).mean() < 0.05
        seen = frame.color.any(axis=-1)
        difference = np.abs(frame.color.astype(int) - true.color).mean(axis=-1)[seen]
        if (frame.color[..., 0] != frame.color[..., 1]).any():  # colour, and nothing to rectify
            assert difference.max() == 0
        grey = true.color @ np.array([0.299, 0.587, 0.114])
        assert np.median(np.abs(frame.color @ np.array([0.299, 0.587, 0.114]) - grey)[seen]) < 3


def test_euroc(euroc, box_scene):
    recording = open_recording(euroc)
    assert (recording.layout, recording.name, len(recording)) == ("euroc", "V1_01_easy", 3)
    assert recording.intrinsics == K
    np.testing.assert_allclose(recording.timestamps, 1403636579.763555584 + 0.05 * np.arange(3))
    np.testing.assert_allclose(recording.truth[:, :3, 3], POSES[:, :3, 3], atol=1e-8)
    check_frames(recording, box_scene)
    assert len(open_sequence(euroc / "mav0", with_truth=True)) == 3


def in_sixteen_bits(path):
    Image.fromarray(np.array(Image.open(path)).astype(np.uint16) * 257).save(path)


FORMS = {
    "16 bits": ("cam*/data/*.png", in_sixteen_bits),
    "marked lists": ("*/data.csv", lambda p: p.write_bytes(b"\xef\xbb\xbf" + p.read_bytes())),
    "marked YAML": ("cam*/sensor.yaml", lambda p: p.write_bytes(b"\xef\xbb\xbf" + p.read_bytes())),
    "OpenCV's YAML": (
        "cam*/sensor.yaml",
        lambda p: p.write_text("%YAML:1.0\n---\n" + p.read_text()),
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_one_recording_in_many_forms(form, euroc, tmp_path):
    folder = shutil.copytree(euroc, tmp_path / "s")
    pattern, change = FORMS[form]
    for path in (folder / "mav0").glob(pattern):
        change(path)
    found, plain = open_recording(folder), open_recording(euroc)
    assert found.source == plain.source
    np.testing.assert_array_equal(found.truth, plain.truth)
    np.testing.assert_array_equal(found.frame(1).color, plain.frame(1).color)
    np.testing.assert_array_equal(found.frame(1).depth, plain.frame(1).depth)


def test_times_of_kitti_in_nanoseconds(kitti, tmp_path):
    folder = shutil.copytree(kitti, tmp_path / "00")
    (folder / "times.txt").write_text("".join(f"{512_000_000_000 + k * 10**8}\n" for k in range(3)))
    with pytest.warns(InputWarning, match=r"times\.txt: times are taken as ns"):
        assert np.allclose(open_recording(folder).timestamps, [512, 512.1, 512.2])


def test_kitti(kitti, box_scene):
    recording = open_recording(kitti)
    assert (recording.layout, recording.has_color) == ("kitti", True)
    np.testing.assert_allclose(recording.timestamps, [0.0, 0.1, 0.2])
    offset = invert(POSES) @ recording.truth  # camera 2 is 6 cm to the right of camera 0
    np.testing.assert_allclose(offset[:, :3, 3], [[0.06, 0, 0]] * 3, atol=1e-8)
    check_frames(recording, box_scene)


def test_rectification_is_that_of_opencv_up_to_the_choice_of_the_axes():
    rig = StereoRig(
        Intrinsics(K.fx, K.fy, K.cx, K.cy, 320, 240, LENSES[0]),
        Intrinsics(K.fx, K.fy, K.cx, K.cy, 320, 240, LENSES[1]),
        T_LEFT_RIGHT,
    )
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 5], (50, 3))  # left frame
    left = points @ rig.R_left_rectified
    right = (
        (points - T_LEFT_RIGHT[:3, 3])
        @ T_LEFT_RIGHT[:3, :3]
        @ (T_LEFT_RIGHT[:3, :3].T @ rig.R_left_rectified)
    )
    np.testing.assert_allclose(left - right, [[rig.baseline_m, 0, 0]] * 50, atol=1e-12)
    T = invert(T_LEFT_RIGHT)
    numbers = [np.array([d.k1, d.k2, d.p1, d.p2, 0]) for d in LENSES]
    args = K.matrix, numbers[0], K.matrix, numbers[1], (320, 240), T[:3, :3], T[:3, 3:]
    R1, _, P1, P2, *_ = cv2.stereoRectify(*args)
    assert -P2[0, 3] / P1[0, 0] == pytest.approx(rig.baseline_m)
    np.testing.assert_allclose(R1[0], rig.R_left_rectified[:, 0], atol=1e-9)


def test_the_command_runs_on_both(euroc, kitti, tmp_path, capsys):
    for folder in (euroc, kitti):
        size = ["--image-size", "160x120"]
        assert main(["run", str(folder), *size, "--out", str(tmp_path / folder.name)]) == 0
        assert float(re.search(r"ate_m +(\S+)", capsys.readouterr().out)[1]) < 0.02


@pytest.mark.parametrize(
    ("file", "old", "new", "complaint"),
    [
        ("mav0/cam0/sensor.yaml", "pinhole", "omni", "camera_model 'omni' is unknown; valid.*pinh"),
        ("mav0/cam0/sensor.yaml", "radial-tangential", "fov", "distortion model 'fov'; valid choi"),
        ("mav0/cam1/sensor.yaml", "T_BS", "T_SB", "T_BS, the pose of the sensor, is missing"),
        ("mav0/cam1/sensor.yaml", "intrinsics:", "K:", "intrinsics must be a list of 4 numbers"),
        (
            "mav0/cam1/sensor.yaml",
            "intrinsics:",
            "a: &a [1]\nb: *a\nintrinsics:",
            "not a YAML file",
        ),
        ("mav0/cam1/sensor.yaml", "- 320", f"- 1{400 * '0'}", "resolution: 10+...0+ is not finite"),
        ("mav0/cam1/sensor.yaml", "- 320", "- 321", r"images of \(240, 320\) and \(240, 321\)"),
        ("mav0/cam0/data.csv", ".png", "", "cam0/data/.* No such file"),
        ("mav0/cam1/data.csv", "14036", "24036", "no image of cam1 is as old as one of cam0"),
        (
            "mav0/state_groundtruth_estimate0/data.csv",
            "1403636579814555584",
            "5",
            "data.csv:3: timestamp 5",
        ),
    ],
)
def test_faults_of_euroc_are_named(euroc, tmp_path, file, old, new, complaint):
    folder = tmp_path / "copy"
    for path in euroc.rglob("*.*"):
        if path.is_file():
            (folder / path.relative_to(euroc)).parent.mkdir(parents=True, exist_ok=True)
            (folder / path.relative_to(euroc)).write_bytes(path.read_bytes())
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    with pytest.raises(InputError, match=complaint):
        open_recording(folder).frame(0)


def test_faults_of_kitti_are_named(kitti, tmp_path):
    texts = {name: (kitti / name).read_text() for name in ("calib.txt", "times.txt", "poses.txt")}
    cases = {
        "calib.txt": [("P3:", "X:", "has no line P3:"), ("P2: ", "P2: 1 ", "expected 12 numbers")],
        "times.txt": [("0.000000e+00\n", "", r"times\.txt: 2 times for 3 images")],
        "poses.txt": [("\n", " 1\n", "poses.txt:1: expected 12 or 16 numbers, got 13")],
    }
    for name, faults in cases.items():
        for old, new, complaint in faults:
            (kitti / name).write_text(texts[name].replace(old, new, 1))
            with pytest.raises(InputError, match=complaint):
                open_recording(kitti)
            (kitti / name).write_text(texts[name])
    (kitti / "calib.txt").write_text(",\n" + texts["calib.txt"])  # a line without a word
    open_recording(kitti)
    (kitti / "calib.txt").write_text(texts["calib.txt"])
    with pytest.raises(InputError, match="calibration of KITTI is that of its calib"):
        open_recording(kitti, intrinsics=K)
    swapped = tmp_path / "swapped"
    swapped.mkdir()
    for k in (2, 3):
        (swapped / f"image_{k}").symlink_to(kitti / f"image_{5 - k}")
    (swapped / "times.txt").write_text(texts["times.txt"])
    lines = texts["calib.txt"].replace("P2", "PX").replace("P3", "P2").replace("PX", "P3")
    (swapped / "calib.txt").write_text(lines)
    with pytest.raises(InputError, match="right camera must stand to the right"):
        open_recording(swapped)
