"""TUM trajectory files."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import pose_from_quaternion, se3_exp
from ms_slam_env.sequences import read_trajectory, trajectory, write_trajectory

GOOD = "0.0 1 2 3 0 0 0 1"


@settings(max_examples=30, deadline=None)
@given(twists=st.lists(st.tuples(*[st.floats(-3, 3)] * 6), min_size=1, max_size=5))
def test_what_was_written_is_read(tmp_path_factory, twists) -> None:
    path = tmp_path_factory.mktemp("tum") / "trajectory.txt"
    poses = np.stack([se3_exp(twist) for twist in twists])
    times = np.arange(len(poses)) / 30.0
    write_trajectory(path, times, poses)
    read_times, read_poses = read_trajectory(path)
    np.testing.assert_allclose(read_times, times, atol=1e-6)
    np.testing.assert_allclose(read_poses, poses, atol=1e-7)


def test_evo_reads_the_file(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    poses = np.stack([se3_exp([0.1 * k, 0, 1, 0.2, 0.1 * k, 0]) for k in range(4)])
    write_trajectory(tmp_path / "t.txt", np.arange(4), poses)
    trajectory = file_interface.read_tum_trajectory_file(tmp_path / "t.txt")
    np.testing.assert_allclose(np.stack(trajectory.poses_se3), poses, atol=1e-7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.0 1 2 3 0 0 0", "line 1: expected the 8 numbers"),
        (f"# comment\n\n{GOOD}\n1.0 a 2 3 0 0 0 1", "line 4: expected the 8 numbers"),
        (f"{GOOD}\n1.0 nan 2 3 0 0 0 1", "line 2: a number is not finite"),
        ("0.0 1 2 3 0 0 0 0", "line 1: the quaternion"),
        (f"{GOOD}\n{GOOD}", "line 2: timestamp 0.0 does not come after"),
        ("# nothing\n", "holds no pose"),
    ],
)
def test_a_bad_file_is_refused_naming_file_and_line(tmp_path: Path, text, message) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        read_trajectory(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read trajectory"):
        read_trajectory(tmp_path / "none.txt")


def test_lengths_must_match(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="2 timestamps"):
        write_trajectory(tmp_path / "t.txt", [0.0, 1.0], np.eye(4)[None])


ROWS = [f"{t} {k} 2 3 0 0 0.6 0.8" for k, t in enumerate(("512.0", "512.1", "512.25"))]
NUMBERED = "\n".join(ROWS)
SAME_FILE = {
    "byte order mark": "\ufeff# comment\n" + NUMBERED,
    "mark without comment": "\ufeff" + NUMBERED,
    "decimal commas": NUMBERED.replace(".", ","),
    "semicolons": NUMBERED.replace(" ", "; "),
    "semicolons and decimal commas": NUMBERED.replace(".", ",").replace(" ", ";"),
    "commas": NUMBERED.replace(" ", ","),
    "tabs and CRLF": NUMBERED.replace(" ", "\t").replace("\n", "\r\n"),
    "other columns": "# timestamp, qw qx qy qz tx ty tz\n"
    + "\n".join(f"{r.split()[0]} 0.8 0 0 0.6 {' '.join(r.split()[1:4])}" for r in ROWS),
    "seconds, said": "# time [s]\n" + NUMBERED,
    "nanoseconds, said": "# timestamp [ns]\n"
    + "\n".join(f"{round(1e9 * float(r.split()[0]))} {r.split(' ', 1)[1]}" for r in ROWS),
}


@pytest.mark.parametrize("form", SAME_FILE)
def test_one_trajectory_in_many_forms(tmp_path: Path, form) -> None:
    (tmp_path / "t.txt").write_bytes(SAME_FILE[form].encode())
    times, poses = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(times, [512.0, 512.1, 512.25], rtol=1e-12)
    np.testing.assert_array_equal(poses[:, :3, 3], [[0, 2, 3], [1, 2, 3], [2, 2, 3]])
    np.testing.assert_allclose(poses[:, 0, 0], 0.28, atol=1e-12)


@pytest.mark.parametrize(
    ("start", "step", "factor", "guessed"),
    [
        (1_305_031_102_175_304_000, 33_333_333, 1e-9, False),
        (1_305_031_102_175_304, 33_333, 1e-6, False),
        (1_305_031_102_175, 33, 1e-3, False),
        (512_000_000_000, 33_333_333, 1e-9, True),
        (512_000_000, 33_333, 1e-6, True),
        (2_000_000_000_000_000, 33_333_333, 1e-9, True),  # 23 days since boot, 2033 as us
        (1305031102.17, 0.033, 1.0, False),
        (0, 1, 1.0, False),
        (0, 60, 1.0, False),
    ],
)
def test_the_unit_of_times_is_recognised_and_a_guess_is_said(
    tmp_path: Path, start, step, factor, guessed
) -> None:
    stamps = [start + k * step for k in range(5)]
    (tmp_path / "t.txt").write_text("\n".join(f"{s} 0 0 0 0 0 0 1" for s in stamps))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        times, _ = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(times, np.array(stamps) * factor, rtol=1e-15, atol=1e-6)
    assert len(said) == guessed
    if guessed:
        assert re.search("taken as [nu]s, since they are .* apart", str(said[0].message))


def test_a_long_trajectory_is_read_and_written_in_one_piece(tmp_path: Path, monkeypatch) -> None:
    twists = np.random.default_rng(0).normal(size=(500, 6))
    poses = np.stack([se3_exp(twist) for twist in twists])
    write_trajectory(tmp_path / "t.txt", np.arange(500) / 30, poses)
    calls = []
    own = trajectory.pose_from_quaternion
    monkeypatch.setattr(
        trajectory, "pose_from_quaternion", lambda *args: calls.append(1) or own(*args)
    )
    _, read = read_trajectory(tmp_path / "t.txt")
    assert len(calls) == 1
    lines = (tmp_path / "t.txt").read_text().splitlines()[1:]
    for k, line in enumerate(lines):  # one by one, to the bit
        numbers = list(map(float, line.split()))
        np.testing.assert_array_equal(read[k], pose_from_quaternion(numbers[1:4], numbers[4:]))
        assert line == trajectory.trajectory_line(k / 30, poses[k])
