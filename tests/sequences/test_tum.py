"""TUM trajectory files."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import se3_exp
from ms_slam_env.sequences import read_trajectory, write_trajectory

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
