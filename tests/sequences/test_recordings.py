"""Recorded sequences: four folder layouts, and one clear error for each way they can be broken."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.depth_registration import ColorCamera
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.sequences import associate, open_sequence, write_trajectory
from ms_slam_env.sequences.recording import open_recording, parse_calibration
from ms_slam_env.sequences.recording.listings import flip_y

LR_KT3 = Path(__file__).resolve().parents[3] / "shared/data/icl_nuim/lr_kt3_depth"
WIDTH, HEIGHT = 32, 24
INTRINSICS = "30 30 15.5 11.5 32 24"


def depth_values(index):
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return (1000 + 100 * index + 10 * v + u).astype(np.uint16)


def colors(index):
    return np.full((HEIGHT, WIDTH, 3), (10 * index, 20, 30), dtype=np.uint8)


def poses(count):
    return np.stack([make_pose(so3_exp([0, 0.1 * k, 0]), [0.1 * k, 0, 1]) for k in range(count)])


def write_images(folder, count=3, depth="depth/{}.png", color="rgb/{}.png"):
    for index in range(count):
        for pattern, pixels in ((depth, depth_values(index)), (color, colors(index))):
            path = folder / pattern.format(index)
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(pixels).save(path)


@pytest.fixture
def tum(tmp_path):
    folder = tmp_path / "recording"
    write_images(folder)
    listing = "# timestamp filename\n" + "".join(f"{k / 30:.6f} rgb/{k}.png\n" for k in range(3))
    (folder / "rgb.txt").write_text(listing)
    depth = "".join(f"{k / 30 + 0.004:.6f} depth/{k}.png\n" for k in range(3))
    (folder / "depth.txt").write_text(depth)
    (folder / "intrinsics.txt").write_text(f"# fx fy cx cy width height\n{INTRINSICS} 1000\n")
    write_trajectory(folder / "groundtruth.txt", np.arange(3) / 30, poses(3))
    return folder


def test_tum_layout(tum):
    recording = open_recording(tum)
    assert (recording.layout, len(recording), recording.has_color) == ("tum", 3, True)
    assert recording.source == Intrinsics(30, 30, 15.5, 11.5, 32, 24)
    for index, frame in enumerate(recording):
        np.testing.assert_allclose(frame.depth, depth_values(index) / 1000, rtol=1e-6)
        np.testing.assert_array_equal(frame.color, colors(index))
        assert frame.timestamp == pytest.approx(index / 30 + 0.004, abs=1e-6)
    np.testing.assert_allclose(recording.truth, poses(3), atol=1e-8)


FORMS = {
    "mark and CRLF": lambda text: "\ufeff" + text.replace("\n", "\r\n"),
    "decimal commas": lambda text: re.sub(r"^(\d+)\.", r"\1,", text, flags=re.MULTILINE),
    "commas between": lambda text: re.sub(r"^(\S+) ", r"\1,", text, flags=re.MULTILINE),
    "backslashes": lambda text: text.replace("/", "\\"),
    "quoted": lambda text: re.sub(r"(depth|rgb)/(\d)", r'"\1/\2', text).replace("png", 'png"'),
    "nanoseconds": lambda text: re.sub(r"\b(\d)\.(\d{6})\b", r"\1\g<2>000", text),
    "blanks": lambda text: text.replace("depth/", "depth/a b# ").replace("filename", "a#"),
}


@pytest.mark.parametrize("form", FORMS)
def test_one_listing_in_many_forms(tum, form):
    if form == "blanks":
        for path in (tum / "depth").iterdir():
            path.rename(path.with_name(f"a b# {path.name}"))
    for name in ("rgb.txt", "depth.txt"):
        text = FORMS[form]((tum / name).read_text())
        text = re.sub(r"depth/a b# (\d.png)", r'"depth/a b# \1"', text)
        if form == "nanoseconds":
            text = "# [ns]\n" + text
        (tum / name).write_bytes(text.encode())
    recording = open_recording(tum)
    np.testing.assert_allclose(recording.timestamps, np.arange(3) / 30 + 0.004, atol=1e-6)
    np.testing.assert_allclose(recording.frame(2).depth, depth_values(2) / 1000, rtol=1e-6)
    np.testing.assert_array_equal(recording.frame(2).color, colors(2))


def test_associations_in_either_order(tum):
    for line in ("{0} depth/{0}.png {0} rgb/{0}.png\n", "{0} rgb/{0}.png {0} depth/{0}.png\n"):
        (tum / "associations.txt").write_text("".join(line.format(k) for k in range(3)))
        recording = open_recording(tum)
        assert [entry.depth.parent.name for entry in recording.entries] == ["depth"] * 3
        assert list(recording.timestamps) == [0, 1, 2]


def test_icl_nuim_layout_turns_its_mirrored_poses(tmp_path):
    folder = tmp_path / "living_room_traj0"
    write_images(folder)
    lines = "".join(f"{k} depth/{k}.png {k} rgb/{k}.png\n" for k in range(3))
    (folder / "associations.txt").write_text(lines)
    (folder / "intrinsics.txt").write_text("30 -30 15.5 11.5 32 24\n")
    write_trajectory(folder / "livingRoom0.gt.freiburg", np.arange(3), poses(3))
    recording = open_recording(folder)
    assert (recording.layout, recording.depth_scale) == ("icl-nuim", 5000)
    assert recording.source.fy == 30
    # A point seen at v rows below the centre must lie below in the camera's frame, in the same
    # mirrored world: fy < 0 with y up gives the same pixels as fy > 0 with y down.
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    point = np.array([0.3, 0.2, 1.5, 1.0])
    for T_up, T_down in zip(poses(3), recording.truth, strict=True):
        np.testing.assert_allclose(mirror @ T_up @ point, T_down @ (mirror @ point), atol=1e-8)
    np.testing.assert_allclose(flip_y(flip_y(poses(3))), poses(3))


def test_seven_scenes_layout(tmp_path):
    folder = tmp_path / "seq-01"
    write_images(folder, 2, "frame-00000{}.depth.png", "frame-00000{}.color.png")
    broken = depth_values(0)
    broken[3, 4] = 65535
    Image.fromarray(broken).save(folder / "frame-000000.depth.png")
    for index, T in enumerate(poses(2)):
        np.savetxt(folder / f"frame-00000{index}.pose.txt", T)
    (folder / "intrinsics.txt").write_text(INTRINSICS)
    recording = open_recording(folder)
    assert (recording.layout, len(recording)) == ("7-scenes", 2)
    depth = recording.frame(0).depth
    assert depth[3, 4] == 0
    assert depth[0, 0] == pytest.approx(1.0)
    np.testing.assert_allclose(recording.truth, poses(2))


def test_seven_scenes_has_a_published_calibration(tmp_path):
    folder = tmp_path / "seq-01"
    write_images(folder, 1, "frame-00000{}.depth.png", "frame-00000{}.color.png")
    assert open_recording(folder).source == Intrinsics(585, 585, 320, 240, 640, 480)


def test_plain_folder_pairs_by_number(tmp_path):
    folder = tmp_path / "mine"
    write_images(folder, 12)
    (folder / "intrinsics.txt").write_text(f"{INTRINSICS} 2000")
    recording = open_recording(folder)
    assert recording.layout == "folder"
    assert [entry.depth.name for entry in recording.entries][-2:] == ["10.png", "11.png"]
    np.testing.assert_allclose(recording.frame(11).depth, depth_values(11) / 2000, rtol=1e-6)


@pytest.mark.parametrize("name", ["rgbd_dataset_freiburg2_desk", "fr2_desk", "tum-fr2-xyz", "fr2"])
def test_published_calibrations_of_tum_are_said(tum, name):
    (tum / "intrinsics.txt").unlink()
    with pytest.warns(
        InputWarning, match="published ones of TUM freiburg2, by its name, 520.9 521"
    ):
        recording = open_recording(tum.rename(tum.with_name(name)))
    assert recording.source == Intrinsics(520.9, 521.0, 325.1, 249.7, 640, 480)


@pytest.mark.parametrize(
    "name", ["kitchen_fr30", "sofr2024", "fr30", "my_fr3_desk", "fr2x", "fr4_a"]
)
def test_other_names_have_no_calibration(tum, name):
    (tum / "intrinsics.txt").unlink()
    with pytest.raises(InputError, match=f"intrinsics of .*{name} are missing"):
        open_recording(tum.rename(tum.with_name(name)))


def test_a_plain_folder_must_say_its_depth_scale(tmp_path):
    write_images(tmp_path)
    (tmp_path / "intrinsics.txt").write_text(INTRINSICS)
    with pytest.raises(InputError, match=r"depth scale of .* is missing: .* 1000 for millimetres"):
        open_recording(tmp_path)
    with pytest.raises(InputError, match="depth scale"):
        open_recording(tmp_path, intrinsics=Intrinsics(30, 30, 15.5, 11.5, 32, 24))
    given = parse_calibration(f"{INTRINSICS} 1000".split(), "here")
    frame = open_recording(tmp_path, intrinsics=given).frame(0)
    np.testing.assert_allclose(frame.depth, depth_values(0) / 1000, rtol=1e-6)


@pytest.mark.parametrize("layout", ["tum", "folder"])
def test_saturated_depth_is_no_reading(tum, layout):
    values = depth_values(0)
    values[3, 4] = 65535
    Image.fromarray(values).save(tum / "depth/0.png")
    depth = open_recording(tum, layout).frame(0).depth
    assert depth[3, 4] == 0
    assert depth[3, 5] == pytest.approx(values[3, 5] / 1000)


def test_3dmatch_says_its_camera_and_is_registered(tmp_path):
    write_images(tmp_path, 3, "frame-00000{}.depth.png", "frame-00000{}.color.png")
    K = Intrinsics(31, 32, 15, 11, WIDTH, HEIGHT)
    np.savetxt(tmp_path / "camera-intrinsics.txt", K.matrix)
    for index, T in enumerate(poses(3)):
        lost = np.full((4, 4), -np.inf)
        np.savetxt(tmp_path / f"frame-00000{index}.pose.txt", lost if index == 1 else T)
    with pytest.warns(InputWarning, match="as registered with depth, for there is a camera-intr"):
        sequence = open_sequence(tmp_path)
    assert sequence.intrinsics == K
    assert sequence.frames.registration is None
    np.testing.assert_array_equal(sequence.frames[2].color, colors(2))
    assert sequence.known.tolist() == [True, False, True]
    np.testing.assert_allclose(sequence.poses[2], poses(3)[2])
    (tmp_path / "camera-intrinsics.txt").write_text("31 0 15\n0 32 11\n")
    with pytest.raises(
        InputError, match=r"camera-intrinsics\.txt: expected 3 rows of 3 numbers or"
    ):
        open_sequence(tmp_path)


def test_replica(tmp_path):
    folder = tmp_path / "office0"
    write_images(folder, 3, "results/depth00000{}.png", "results/frame00000{}.jpg")
    camera = {
        "w": WIDTH,
        "h": HEIGHT,
        "fx": 30.0,
        "fy": 31,
        "cx": 15.5,
        "cy": 11.5,
        "scale": 6553.5,
    }
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    lines = "".join(" ".join(f"{v:.9e}" for v in T.ravel()) + "\n" for T in poses(3))
    (folder / "traj.txt").write_text(lines)
    recording = open_recording(folder)
    assert (recording.layout, recording.has_color) == ("replica", True)
    assert recording.source == Intrinsics(30, 31, 15.5, 11.5, WIDTH, HEIGHT)
    np.testing.assert_allclose(recording.frame(2).depth, depth_values(2) / 6553.5, rtol=1e-6)
    assert np.abs(recording.frame(2).color.astype(int) - colors(2)).max() < 8
    np.testing.assert_allclose(recording.truth, poses(3), atol=1e-8)
    np.testing.assert_allclose(recording.truth_times, np.arange(3) / 30)
    (folder / "traj.txt").write_text(lines.partition("\n")[0])
    with pytest.raises(InputError, match=r"traj\.txt: 1 poses for 3 frames"):
        open_recording(folder)
    (tmp_path / "cam_params.json").write_text('{"camera": {"w": "x"}}')
    with pytest.raises(
        InputError, match=r"cam_params\.json: expected a camera with the numbers fx"
    ):
        open_recording(folder)


@pytest.fixture
def scannet(tmp_path):
    """Colour twice as large as depth and by another camera; the pose of frame 1 is lost."""
    folder = tmp_path / "scene0000_00"
    write_images(folder, 3, "depth/{}.png", "color/{}.jpg")
    v, u = np.mgrid[: 2 * HEIGHT, : 2 * WIDTH]
    ramp = np.stack([4 * u, 4 * v, 0 * u], axis=-1).astype(np.uint8)
    for index, T in enumerate(poses(3)):
        Image.fromarray(ramp).save(folder / f"color/{index}.jpg", quality=100, subsampling=0)
        path = folder / f"pose/{index}.txt"
        path.parent.mkdir(exist_ok=True)
        np.savetxt(path, np.full((4, 4), -np.inf) if index == 1 else T)
    for name, K in (("depth", (30, 30, 15.5, 11.5)), ("color", (66, 66, 31.0, 23.0))):
        path = folder / f"intrinsic/intrinsic_{name}.txt"
        path.parent.mkdir(exist_ok=True)
        matrix = np.eye(4)
        matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = K
        np.savetxt(path, matrix)
    return folder


def test_scannet(scannet):
    sequence = open_sequence(scannet)
    assert (sequence.frames.layout, sequence.frames.depth_scale) == ("folder", 1000)
    assert sequence.intrinsics == Intrinsics(30, 30, 15.5, 11.5, WIDTH, HEIGHT)
    assert sequence.known.tolist() == [True, False, True]
    np.testing.assert_allclose(sequence.poses[2], poses(3)[2])
    u, v = 20, 9  # seen by the colour camera at 66 / 30 (u - 15.5) + 31
    want = 4 * (66 / 30 * (u - 15.5) + 31), 4 * (66 / 30 * (v - 11.5) + 23)
    np.testing.assert_allclose(sequence.frames[0].color[v, u, :2], want, atol=4)
    for path in (scannet / "pose").iterdir():
        path.write_text("-inf -inf -inf -inf\n" * 4)
    with pytest.raises(InputError, match="pose holds no pose of a frame"):
        open_sequence(scannet)


def test_what_lies_there_and_is_not_read_is_named(tum):
    for name in ("calibration.yaml", "traj.txt", "poses.csv", "accelerometer.txt", "notes.md"):
        (tum / name).write_text("")
    with pytest.warns(InputWarning, match="not read: calibration.yaml, poses.csv, traj.txt$"):
        open_recording(tum)


def test_a_depth_camera_sees_colour_where_the_colour_camera_has_it():
    K = Intrinsics(30, 30, 15.5, 11.5, WIDTH, HEIGHT)
    of_color = Intrinsics(50, 50, 30, 22, 64, 48)
    T = make_pose(so3_exp([0.02, -0.05, 0.1]), [0.05, 0.01, -0.02])
    v, u = np.mgrid[:48, :64]
    color = np.stack([4 * u, 4 * v, 0 * u], axis=-1).astype(np.uint8)
    depth = np.linspace(1, 3, WIDTH * HEIGHT, dtype=np.float32).reshape(HEIGHT, WIDTH)
    found, is_seen = ColorCamera(of_color, T).register(color, depth, K)
    points = K.rays() * depth[..., None]
    want = 4 * of_color.project(points @ T[:3, :3].T + T[:3, 3])
    np.testing.assert_allclose(found[..., :2], want.clip(0), atol=0.6)  # replicated beyond
    inside = ((want / 4 >= -0.5) & (want / 4 <= [63.5, 47.5])).all(axis=-1)
    np.testing.assert_array_equal(is_seen, inside)
    assert 0 < (~is_seen).sum() < 50


def test_given_intrinsics_come_first(tum):
    given = parse_calibration(["31", "32", "15", "11", "32", "24", "2000"], "here")
    recording = open_recording(tum, intrinsics=given)
    assert recording.source == Intrinsics(31, 32, 15, 11, 32, 24)
    np.testing.assert_allclose(recording.frame(0).depth, depth_values(0) / 2000, rtol=1e-6)
    recording = open_recording(tum, intrinsics=Intrinsics(31, 32, 15, 11, 32, 24))
    assert (recording.source.fx, recording.depth_scale) == (31, 5000)


def test_depth_without_colour_of_its_time_is_said_to_be_left_out(tum):
    open_recording(tum)
    (tum / "rgb.txt").write_text("0.0 rgb/0.png\n")
    with pytest.warns(InputWarning, match="only 1 of 3 depth images have colour of their time"):
        assert len(open_recording(tum)) == 1


def test_depth_alone_has_black_colour(tum):
    (tum / "rgb.txt").unlink()
    with pytest.raises(InputError, match=r"rgb\.txt is missing, which lists the images of rgb"):
        open_recording(tum)
    shutil.rmtree(tum / "rgb")
    recording = open_recording(tum)
    assert not recording.has_color
    assert not recording.frame(0).color.any()


@pytest.mark.skipif(not LR_KT3.is_dir(), reason="lr_kt3_depth is not on this machine")
def test_lr_kt3_at_half_size():
    recording = open_recording(LR_KT3).at_size("160x120")
    assert (len(recording), recording.intrinsics.shape) == (600, (120, 160))
    assert recording.intrinsics.cx == pytest.approx((159.75 + 0.5) / 2 - 0.5)
    frame = recording.frame(599)
    assert frame.depth.shape == (120, 160)
    assert 0.5 < np.median(frame.depth[frame.depth > 0]) < 5


def test_association_is_mutual_and_bounded():
    first = np.array([0.0, 0.033, 0.066, 1.0])
    second = np.array([0.004, 0.036, 0.041, 0.9])
    np.testing.assert_array_equal(associate(first, second, 0.02), [[0, 1], [0, 1]])


def broken(folder, name, text):
    (folder / name).write_text(text)


CASES = {
    "no such folder": (lambda f: f / "nowhere", "not a folder"),
    "empty folder": (lambda f: (f / "empty").mkdir() or f / "empty", "is no RGB-D sequence"),
    "empty listing": (lambda f: broken(f, "depth.txt", "# nothing\n"), r"depth\.txt lists no im"),
    "unsorted": (
        lambda f: broken(f, "depth.txt", "1 depth/0.png\n0.5 depth/1.png\n"),
        r"depth\.txt:2: timestamp 0\.5 does not come after 1",
    ),
    "duplicate": (
        lambda f: broken(f, "depth.txt", "1 depth/0.png\n1 depth/1.png\n"),
        r"depth\.txt:2: timestamp 1 does not come after 1",
    ),
    "not a number": (
        lambda f: broken(f, "rgb.txt", "\nnoon rgb/0.png\n"),
        r"rgb\.txt:2: 'noon' is not a number",
    ),
    "three words": (
        lambda f: broken(f, "depth.txt", "0 depth/0.png 1\n"),
        r"depth\.txt:1: expected 'timestamp filename'",
    ),
    "no intrinsics": (lambda f: (f / "intrinsics.txt").unlink(), "intrinsics of .* are missing"),
    "short intrinsics": (
        lambda f: broken(f, "intrinsics.txt", "# fx\n30 30 15\n"),
        r"intrinsics\.txt:2: expected 'fx fy cx cy width height",
    ),
    "NaN pose": (
        lambda f: broken(f, "groundtruth.txt", "0 nan 0 0 0 0 0 1\n"),
        r"groundtruth\.txt, line 1: a number is not finite",
    ),
    "NaN time": (
        lambda f: broken(f, "depth.txt", "nan depth/0.png\n"),
        r"depth\.txt:1: nan is not finite",
    ),
    "NaN intrinsics": (
        lambda f: broken(f, "intrinsics.txt", "30 nan 15.5 11.5 32 24\n"),
        r"intrinsics\.txt:1: nan is not finite",
    ),
    "no focal length": (
        lambda f: broken(f, "intrinsics.txt", "0 30 15.5 11.5 32 24\n"),
        r"intrinsics\.txt:1: focal lengths",
    ),
    "depth scale of zero": (
        lambda f: broken(f, "intrinsics.txt", f"{INTRINSICS} 0\n"),
        r"intrinsics\.txt:1: depth_scale",
    ),
    "unsorted poses": (
        lambda f: broken(f, "groundtruth.txt", "1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n"),
        r"groundtruth\.txt, line 2: timestamp 0\.0 does not come after 1\.0",
    ),
    "no text": (
        lambda f: (f / "depth.txt").write_bytes(b"\xff\xfe\x00\x81"),
        r"cannot read .*depth\.txt",
    ),
    "times that never meet": (
        lambda f: broken(f, "rgb.txt", "100 rgb/0.png\n"),
        r"no image of rgb\.txt is as old",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_broken_listings(tum, case):
    breaks, message = CASES[case]
    where = breaks(tum)
    with pytest.raises(InputError, match=message) as caught:
        open_recording(where if isinstance(where, Path) else tum)
    assert "\n" not in str(caught.value)


REMOVED = (lambda p: p.unlink(), "No such file")
CUT = (lambda p: p.write_bytes(p.read_bytes()[:60]), "truncated|cannot identify|broken")
IMAGES = {
    ("depth", "missing"): REMOVED,
    ("depth", "truncated"): CUT,
    ("depth", "another size"): (
        lambda p: Image.fromarray(depth_values(0)[:20]).save(p),
        "is 32x20 but the intrinsics say 32x24",
    ),
    ("depth", "colour"): (
        lambda p: Image.fromarray(colors(0)).save(p),
        "not a 16-bit depth image",
    ),
    ("rgb", "missing"): REMOVED,
    ("rgb", "truncated"): CUT,
    ("rgb", "empty"): (lambda p: p.write_bytes(b""), "cannot identify"),
    ("rgb", "another size"): (
        lambda p: Image.fromarray(colors(0)[:, :16]).save(p),
        "is 16x24 but the intrinsics say 32x24",
    ),
    ("rgb", "depth"): (lambda p: Image.fromarray(depth_values(0)).save(p), "not a colour image"),
}


@pytest.mark.parametrize(("kind", "case"), IMAGES)
def test_broken_images(tum, kind, case):
    breaks, message = IMAGES[kind, case]
    breaks(tum / kind / "1.png")
    recording = open_recording(tum)
    recording.frame(0)
    with pytest.raises(InputError, match=message) as caught:
        recording.frame(1)
    assert re.search(rf"depth\.txt:2: .*{kind}/1\.png", str(caught.value))
    assert "\n" not in str(caught.value)


def test_unsorted_and_duplicate_associations(tum):
    lines = ["0 depth/0.png 0 rgb/0.png", "1 depth/1.png 1 rgb/1.png"]
    for order in ([1, 0], [0, 0]):
        (tum / "associations.txt").write_text("\n".join(lines[k] for k in order))
        with pytest.raises(InputError, match=r"associations\.txt:2: timestamp .* does not come"):
            open_recording(tum)
    (tum / "associations.txt").write_text("0 depth/0.png 0")
    with pytest.raises(InputError, match=r"associations\.txt:1: expected 'time file time file'"):
        open_recording(tum)
    (tum / "associations.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match=r"associations\.txt lists no image"):
        open_recording(tum)


POSES = {
    "NaN": ("1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", r"pose\.txt:1: nan is not finite"),
    "word": ("1 0 0 0\n0 1 0 x\n0 0 1 0\n0 0 0 1\n", r"pose\.txt:2: 'x' is not a number"),
    "three rows": ("1 0 0 0\n0 1 0 0\n0 0 1 0\n", "expected 4 rows of 4 numbers"),
    "empty": ("", "expected 4 rows of 4 numbers"),
    "no rotation": ("2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "is not a rigid motion"),
    "mirror": ("-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "is not a rigid motion"),
}


@pytest.mark.parametrize("case", POSES)
def test_broken_poses_of_seven_scenes(tmp_path, case):
    folder = tmp_path / "seq-01"
    write_images(folder, 2, "frame-00000{}.depth.png", "frame-00000{}.color.png")
    (folder / "intrinsics.txt").write_text(INTRINSICS)
    text, message = POSES[case]
    (folder / "frame-000001.pose.txt").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        open_recording(folder)
    assert "frame-000001.pose.txt" in str(caught.value)


def test_a_rounded_rotation_is_made_orthonormal(tmp_path):
    folder = tmp_path / "seq-01"
    write_images(folder, 1, "frame-00000{}.depth.png", "frame-00000{}.color.png")
    (folder / "intrinsics.txt").write_text(INTRINSICS)
    exact = make_pose(so3_exp([0.4, -0.2, 0.7]), [1, 2, 3])
    np.savetxt(folder / "frame-000000.pose.txt", exact, fmt="%.3f")
    T = open_recording(folder).truth[0]
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(T, exact, atol=2e-3)


def test_seven_scenes_without_colour(tmp_path):
    folder = tmp_path / "seq-01"
    write_images(folder, 2, "frame-00000{}.depth.png", "frame-00000{}.color.png")
    (folder / "intrinsics.txt").write_text(INTRINSICS)
    (folder / "frame-000000.color.png").unlink()
    with pytest.raises(InputError, match=r"frame-000000\.color\.png: No such file"):
        open_recording(folder).frame(0)
    (folder / "frame-000001.color.png").unlink()
    recording = open_recording(folder)
    assert not recording.has_color
    assert not recording.frame(0).color.any()


def test_empty_and_unequal_folders(tmp_path):
    folder = tmp_path / "mine"
    (folder / "depth").mkdir(parents=True)
    (folder / "intrinsics.txt").write_text(f"{INTRINSICS} 1000")
    with pytest.raises(InputError, match=r"mine/depth holds no image"):
        open_recording(folder)
    write_images(folder, 2)
    (folder / "rgb/1.png").unlink()
    with pytest.raises(InputError, match="2 depth images but 1 colour images"):
        open_recording(folder)


def test_unknown_choices(tum):
    with pytest.raises(InputError, match="unknown layout 'zip'; valid choices: auto, tum"):
        open_recording(tum, layout="zip")
    recording = open_recording(tum)
    with pytest.raises(InputError, match="valid choices: 80x60"):
        recording.at_size("1x1")
    with pytest.raises(InputError, match="cannot be reduced to 160x120"):
        recording.at_size("160x120")


def test_a_cropped_recording_shows_the_middle(tum):
    recording = open_recording(tum)
    whole, cropped = recording.frame(1), recording.at_size("native+crop=20x10").frame(1)
    assert np.array_equal(cropped.color, whole.color[7:17, 6:26])
    assert np.array_equal(cropped.depth, whole.depth[7:17, 6:26])
    smaller = recording.at_size("8x12+crop")
    assert smaller.intrinsics.fx == recording.source.fx / 2
    reduced = smaller.frame(1)
    part = whole.color[:, 8:24].astype(float).reshape(12, 2, 8, 2, 3).mean(axis=(1, 3))
    assert np.abs(reduced.color - part).max() <= 0.5
    with pytest.raises(InputError, match=r"valid choices: native, 8x12\+crop"):
        recording.at_size("8x12")


def test_parts_follow_each_other(tum, tmp_path):
    again = shutil.copytree(tum, tmp_path / "again")
    whole = open_recording(f"{tum},{again}")
    one = open_recording(tum)
    assert len(whole) == 6
    np.testing.assert_allclose(np.diff(whole.timestamps), 1 / 30, atol=1e-6)
    np.testing.assert_array_equal(whole.frame(4).depth, one.frame(1).depth)
    np.testing.assert_allclose(whole.truth, np.concatenate([one.truth, one.truth]))
    np.testing.assert_allclose(np.diff(whole.truth_times), 1 / 30, atol=1e-6)
    sequence = open_sequence(f"{tum},{again}", "16x12")
    np.testing.assert_allclose(sequence.poses, whole.truth)


def test_parts_whose_truth_is_of_another_time_have_none(tum, tmp_path):
    folder = shutil.copytree(tum, tmp_path / "unix")
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    moved = [
        f"{float(line.split()[0]) + 1e9} {line.split(' ', 1)[1]}"
        for line in lines
        if line[0] != "#"
    ]
    (folder / "groundtruth.txt").write_text("\n".join(moved))
    again = shutil.copytree(folder, tmp_path / "again")
    whole = open_recording(f"{folder},{again}")
    assert whole.truth is None
    assert not open_sequence(f"{folder},{again}", "16x12").known.any()


def test_parts_whose_times_go_on_keep_them(tum, tmp_path):
    later = shutil.copytree(tum, tmp_path / "later")
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = (later / name).read_text().splitlines()
        moved = [
            line
            if line.startswith("#")
            else f"{float(line.split()[0]) + 5} {line.split(' ', 1)[1]}"
            for line in lines
        ]
        (later / name).write_text("\n".join(moved))
    whole = open_recording(f"{tum},{later}")
    np.testing.assert_allclose(whole.timestamps[3:] - whole.timestamps[:3], 5)
    np.testing.assert_allclose(whole.truth_times[3:] - whole.truth_times[:3], 5)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda folder: (folder / "intrinsics.txt").write_text("31 30 15.5 11.5 32 24 1000"),
            "source",
        ),
        (lambda folder: (folder / "groundtruth.txt").unlink(), "only one has a true trajectory"),
        (lambda folder: (folder / "depth.txt").write_text(""), "lists no image"),
        (shutil.rmtree, "no sequence at"),
    ],
)
def test_parts_that_do_not_fit_are_refused(tum, tmp_path, change, said):
    other = shutil.copytree(tum, tmp_path / "other")
    change(other)
    with pytest.raises(InputError, match=said):
        open_recording(f"{tum},{other}")
