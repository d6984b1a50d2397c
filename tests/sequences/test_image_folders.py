"""The plain layout: its colour, times and gaps; what is missing is said."""

import os
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.sequences import write_trajectory
from ms_slam_env.sequences.recording import open_recording
from ms_slam_env.sequences.recording.image_folders import COLOR_FOLDERS

DEPTH = np.full((8, 8), 1000, dtype=np.uint16)
COLOR = np.full((8, 8, 3), 9, dtype=np.uint8)


def make(folder: Path, names: list[str], color: str = "", colors: list[str] | None = None) -> Path:
    """Write a folder of depth images, and one of colour."""
    shutil.rmtree(folder, ignore_errors=True)
    for kind, pixels, stems in (("depth", DEPTH, names), (color, COLOR, colors or names)):
        if kind:
            (folder / kind).mkdir(parents=True)
            for stem in stems:
                Image.fromarray(pixels).save(folder / kind / f"{stem}.png")
    (folder / "intrinsics.txt").write_text("9 9 3.5 3.5 8 8 1000")
    return folder


@pytest.mark.parametrize("name", [*COLOR_FOLDERS, "RGB", "Colour"])
def test_colour_is_found_under_its_usual_names(tmp_path: Path, name: str) -> None:
    recording = open_recording(make(tmp_path / "s", ["0", "1"], name))
    assert recording.has_color
    assert recording.frame(1).color[0, 0, 0] == 9


def test_a_folder_that_is_not_read_is_named(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", ["0", "1"], "webcam")
    with pytest.warns(InputWarning, match="webcam holds images that are not read; .* rgb, color"):
        assert not open_recording(folder).has_color
    (folder / "webcam").rename(folder / "labels")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        open_recording(folder)
    make(folder, ["0", "1"], "rgb")
    shutil.copytree(folder / "rgb", folder / "color")
    with pytest.raises(InputError, match="colour in both color and rgb"):
        open_recording(folder)


@settings(max_examples=50, deadline=None)
@given(st.sets(st.integers(0, 1999), min_size=1, max_size=8), st.sampled_from(["", "cam0_", "f"]))
def test_numbers_of_frames_are_their_times(tmp_path_factory, numbers, prefix) -> None:  # type: ignore[no-untyped-def]
    folder = make(
        tmp_path_factory.getbasetemp() / "numbers", [f"{prefix}{n:05d}_depth" for n in numbers]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        times = open_recording(folder).timestamps
    np.testing.assert_allclose(times, np.array(sorted(numbers)) / 30, atol=1e-12)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["12.5", "12.75"], [12.5, 12.75]),
        (["102.15", "102.2", "102.25", "103.1"], [102.15, 102.2, 102.25, 103.1]),
        (["1305031102160407000", "1305031102193740000"], [1305031102.160407, 1305031102.193740]),
        (["1305031102160407", "1305031102193740"], [1305031102.160407, 1305031102.193740]),
        (["1305031102160", "1305031102193"], [1305031102.160, 1305031102.193]),
        (["512000000000", "512033333333", "512066666667"], [512, 512.033333333, 512.066666667]),
        (["512000000", "512033333", "512066667"], [512, 512.033333, 512.066667]),
        (["0", "33333", "66667"], [0, 0.033333, 0.066667]),
    ],
)
def test_times_in_names(tmp_path: Path, names: list[str], times: list[float]) -> None:
    found = open_recording(make(tmp_path / "s", names, "rgb")).timestamps
    np.testing.assert_allclose(found, times, rtol=0, atol=1e-6)


def test_a_unit_that_steps_tell_is_said_and_held_against_no_truth(tmp_path: Path) -> None:
    names = [f"{round(1e9 * (512 + k / 30))}" for k in range(4)]
    colors = [f"{round(1e9 * (512.004 + k / 30))}" for k in range(4)]
    folder = make(tmp_path / "s", names, "rgb", colors)
    truth = 512 + np.arange(4) / 30 + 0.01
    write_trajectory(folder / "groundtruth.txt", truth, np.tile(np.eye(4), (4, 1, 1)))
    with pytest.warns(InputWarning, match=r"as ns, .* 3\.33333e\+07 apart; a file times\.txt"):
        recording = open_recording(folder)
    np.testing.assert_allclose(recording.timestamps, 512 + np.arange(4) / 30, atol=1e-9)
    (folder / "times.txt").write_text("0\n1\n2\n3")
    assert open_recording(folder).timestamps.tolist() == [0, 1, 2, 3]


STAMPS = [1_466_000_000.5, 1_466_000_000.75, 1_466_000_001.5]
TIMES = {
    "{name} {:.2f} 12.5": STAMPS,
    "{name} {:.2f}": STAMPS,
    "{name}.png,{:.2f},12.5": STAMPS,
    "{:.2f}": STAMPS,
    "{ns}": STAMPS,
    "{name} {ns} 12.5": STAMPS,
    "# time [ms]\n{k}500": [0.5, 1.5, 2.5],
    "# [s]\n{k}00": [0, 100, 200],
    "{k}00": [0, 0.1, 0.2],
    "0,{k}0": None,
    "7 {:.2f} 12.5": None,
    "{:.2f} 12.5": None,
    "{name} {:.2f} 1 2": None,
}


@pytest.mark.filterwarnings("ignore::ms_slam_env.errors.InputWarning")
@pytest.mark.parametrize("form", TIMES)
def test_forms_of_a_file_of_times(tmp_path: Path, form: str) -> None:
    names = ["0000", "0001", "0005"]
    folder = make(tmp_path / "s", names, "rgb")
    lines = [
        form.format(stamp, name=name, ns=round(1e9 * stamp), k=k)
        for k, (name, stamp) in enumerate(zip(names, STAMPS, strict=True))
    ]
    (folder / "times.txt").write_text("\ufeff" + "\n".join(lines) + "\n")
    want = TIMES[form]
    if want is None:
        with pytest.raises(InputError, match=r"times\.txt:\d: expected a time, .* id 000"):
            open_recording(folder)
    else:
        np.testing.assert_allclose(open_recording(folder).timestamps, want, rtol=1e-15, atol=1e-6)


def test_milliseconds_in_a_file_of_times_are_said(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", ["0", "1", "2"])
    (folder / "times.txt").write_text("512000\n512033\n512067\n")
    with pytest.warns(InputWarning, match=r"times\.txt: times are taken as ms, .* 33\.5 apart"):
        assert np.allclose(open_recording(folder).timestamps, [512, 512.033, 512.067])


def test_gaps_are_warned_of_and_keep_their_time(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", ["3", "4", "5", "8", "9", "11"], "rgb")
    said = "leave out 3 frames in 2 gaps, the first after 5.png"
    with pytest.warns(InputWarning, match=said):
        recording = open_recording(folder)
    assert np.allclose(30 * recording.timestamps, [3, 4, 5, 8, 9, 11])
    truth = np.arange(6) / 15
    write_trajectory(folder / "groundtruth.txt", truth, np.tile(np.eye(4), (6, 1, 1)))
    with pytest.warns(InputWarning, match=f"{said}; the true trajectory has one pose a frame"):
        assert np.allclose(open_recording(folder).timestamps, truth)


def test_a_file_of_times_comes_first(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", ["0", "1", "5"])
    (folder / "times.txt").write_text("# seconds\n0.5\n0.75\n1.5\n")
    assert open_recording(folder).timestamps.tolist() == [0.5, 0.75, 1.5]
    (folder / "times.txt").write_text("0.5\n0.75\n")
    with pytest.raises(InputError, match=r"times\.txt: 2 times for 3 images"):
        open_recording(folder)
    (folder / "times.txt").write_text("0.5\n0.75\n0.75\n")
    with pytest.raises(InputError, match="does not come after"):
        open_recording(folder)


def test_names_without_numbers_say_that_times_are_assumed(tmp_path: Path) -> None:
    with pytest.warns(InputWarning, match="30 frames a second are assumed"):
        recording = open_recording(make(tmp_path / "s", ["a1_2", "b2_1"]))
    assert np.allclose(recording.timestamps, [0, 1 / 30])


def test_images_of_other_numbers_are_not_paired(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", ["1", "2", "3", "5"], "rgb", ["1", "2", "4", "5"])
    with pytest.raises(InputError, match=r"depth/3\.png and rgb/4\.png do not belong together"):
        open_recording(folder)
    make(folder, ["0", "1", "2"], "rgb", ["1", "2", "3"])
    assert len(open_recording(folder)) == 3


@pytest.mark.parametrize(
    "name", ["rgb.txt", "depth.txt", "groundtruth.txt", "associations.txt", "intrinsics.txt"]
)
def test_a_listing_whose_link_broke_is_an_error(tmp_path: Path, name: str) -> None:
    folder = make(tmp_path / "s", ["0", "1"], "rgb")
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text(f"0 {kind}/0.png\n1 {kind}/1.png\n")
    open_recording(folder)
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(tmp_path / "gone.txt")
    with pytest.raises(InputError, match=f"cannot read .*{name}: No such file"):
        open_recording(folder)
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(InputError, match=f"{name}: not a regular file"):
        open_recording(folder)


def test_a_listing_that_others_call_for_is_missed(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", ["0", "1"], "color")
    (folder / "rgb.txt").write_text("0 color/0.png\n")
    with pytest.raises(InputError, match=r"depth\.txt is missing, though there is an rgb\.txt"):
        open_recording(folder)
    (folder / "rgb.txt").rename(folder / "depth.txt")
    with pytest.raises(InputError, match=r"rgb\.txt is missing, which lists the images of color"):
        open_recording(folder)
    shutil.rmtree(folder / "color")
    (folder / "sequence.json").write_text("{}")
    with pytest.raises(InputError, match=r"rgb\.txt is missing; every generated sequence has one"):
        open_recording(folder)


def test_seven_scenes_takes_colour_as_jpeg(tmp_path: Path) -> None:
    for index in range(2):
        Image.fromarray(DEPTH).save(tmp_path / f"frame-00000{index}.depth.png")
        Image.fromarray(COLOR).save(tmp_path / f"frame-00000{index}.color.jpg")
    (tmp_path / "intrinsics.txt").write_text("9 9 3.5 3.5 8 8 1000")
    recording = open_recording(tmp_path)
    assert recording.has_color
    assert abs(int(recording.frame(1).color[4, 4, 0]) - 9) < 3


def test_an_id_of_any_length_is_compared_with_the_name(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", ["0", "1"], "rgb")
    (folder / "times.txt").write_text("00000 0.0\n0001 0.1\n")
    np.testing.assert_allclose(open_recording(folder).timestamps, [0.0, 0.1])
    (folder / "times.txt").write_text(f"0 0.0\n{5000 * '1'} 0.1\n")  # more digits than int takes
    with pytest.raises(InputError, match=r"times\.txt:2"):
        open_recording(folder)
