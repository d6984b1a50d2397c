"""Files from elsewhere: regular ones of bounded size."""

import os
from pathlib import Path

import pytest

from ms_slam_env._runtime.input_files import check_file, is_named, read_bytes, read_text
from ms_slam_env.errors import InputError


def test_a_file_is_read_to_its_bound(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes("ä1".encode())
    assert read_text(path, "listing") == "ä1"
    assert read_bytes(path, "listing", 3) == "ä1".encode()
    with pytest.raises(InputError, match=f"cannot read listing {path}: larger than 0 MB"):
        read_bytes(path, "listing", 2)
    path.write_bytes(b"\xff")
    with pytest.raises(InputError, match="not a text file in UTF-8"):
        read_text(path, "listing")


def test_pipes_devices_and_folders_are_no_input(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for path in (tmp_path / "pipe", tmp_path / "zero", tmp_path):
        for read in (read_bytes, check_file):
            with pytest.raises(InputError, match=f"^cannot read image {path}: not a regular file$"):
                read(path, "image", 100)


def test_what_is_not_there_says_so(tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "nowhere")
    assert is_named(link)
    assert not is_named(tmp_path / "nowhere")
    for path in (link, tmp_path / "nowhere"):
        with pytest.raises(InputError, match=f"cannot read image {path}: No such file"):
            read_bytes(path, "image", 100)
    with pytest.raises(InputError, match="cannot read image"):
        read_bytes("a\0b", "image", 100)


def test_a_file_that_does_not_tell_its_size_is_bounded_too() -> None:
    """Those of /proc are regular and have a size of nothing."""
    path = Path("/proc/self/status")
    if not path.is_file():
        pytest.skip("no /proc")
    with pytest.raises(InputError, match="larger than"):
        read_bytes(path, "text", 10)
