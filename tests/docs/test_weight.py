"""What is tracked stays light, by folder: a clone is quick, and goes to any machine."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MIB = 2**20
LIMITS = {
    "docs/results": 6.0,
    "docs/pictures": 4.0,
    "agents/policies": 2.4,
    "ms_slam_env": 3.0,
    "experiments": 0.4,
    "tests": 2.3,
    "notebooks": 0.3,
    "": 20.0,
}
"""Folders, and the most of them in MiB; "" is the whole."""
LARGEST = 1.0
"""MiB of one file."""


def tracked() -> dict[str, int]:
    """Bytes by file."""
    try:
        command = ["git", "-C", str(ROOT), "ls-files", "-z"]
        listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a clone")
    paths = {name: ROOT / name for name in listed.split("\0") if name}
    return {name: path.stat().st_size for name, path in paths.items() if path.is_file()}


@pytest.mark.parametrize("folder", LIMITS)
def test_a_folder_is_as_light_as_agreed(folder: str) -> None:
    """Results are packed (`ms-slam docs --pack`); old ones go before a limit is raised."""
    sizes = [size for name, size in tracked().items() if name.startswith(folder and f"{folder}/")]
    assert 0 < sum(sizes) <= LIMITS[folder] * MIB


def test_no_file_is_large() -> None:
    assert {n: size for n, size in tracked().items() if size > LARGEST * MIB} == {}
