"""The example that runs ORB-SLAM3, with a stand-in for its binding and for its vocabulary."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ms_slam_env.benchmark.command_runs import run_command
from ms_slam_env.errors import InputError
from ms_slam_env.sequences import HandheldPath, open_sequence, read_trajectory

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "examples" / "orb_slam3.py"

STAND_IN = """
from types import SimpleNamespace
import numpy as np
class Sensor:
    RGBD = "rgbd"
class Slam:
    def __init__(self, vocabulary, settings, sensor):
        text = open(settings).read()
        assert open(vocabulary).read() == "words"
        assert sensor == "rgbd" and "Camera.width: 80" in text
        self.scale = float(text.split("DepthMapFactor:")[1].split()[0])
        self.count = 0
    def __enter__(self):
        return self
    def __exit__(self, *error):
        pass
    def track_rgbd(self, color, depth, time):
        assert color.shape == (60, 80, 3) and depth.shape == (60, 80)
        self.count += 1
        pose = np.eye(4)
        pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
        pose[:3, 3] = time, color.mean(), depth.max() / self.scale
        return SimpleNamespace(ok=self.count != 3, pose_wc=pose)
"""


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "pyorbslam3.py").write_text(STAND_IN)
    (tmp_path / "words.txt").write_text("words")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    options = f"--vocabulary {tmp_path}/{{}} --in {{{{sequence}}}} --out {{{{trajectory}}}}"
    return f"command:{sys.executable} {SCRIPT} {options}"


def test_images_reach_it_and_poses_come_back(command: str, tmp_path: Path) -> None:
    sequence = open_sequence("table:1000:none", "80x60", path=HandheldPath(10), with_truth=True)
    run_command(command.format("words.txt"), sequence, tmp_path / "t.txt", 60.0)
    times, poses = read_trajectory(tmp_path / "t.txt")
    kept = [index for index in range(10) if index != 2]  # the third frame was not tracked
    np.testing.assert_allclose(times, sequence.timestamps[kept], atol=1e-5)
    for pose, index in zip(poses, kept, strict=True):
        frame = sequence.frames[index]
        expected = frame.timestamp, frame.color.mean(), frame.depth.max()
        np.testing.assert_allclose(pose[:3, 3], expected, atol=1e-3)
        np.testing.assert_allclose(pose[:3, 0], (0, 1, 0), atol=1e-6)


def test_a_missing_vocabulary_is_named(command: str, tmp_path: Path) -> None:
    sequence = open_sequence("table:1000:none", "80x60", path=HandheldPath(10), with_truth=True)
    with pytest.raises(InputError, match=r"no vocabulary .*none\.txt"):
        run_command(command.format("none.txt"), sequence, tmp_path / "t.txt", 60.0)


def test_quaternions_are_scipys() -> None:
    spec = importlib.util.spec_from_file_location("orb_slam3", SCRIPT)
    assert spec
    assert spec.loader
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    turns = [*Rotation.random(50, random_state=0), *Rotation.from_rotvec(np.pi * np.eye(3))]
    for turn in turns:
        found = Rotation.from_quat(script.quaternion(turn.as_matrix()))
        assert (found * turn.inv()).magnitude() < 1e-7


def test_the_package_never_imports_it() -> None:
    root = SCRIPT.parents[2]
    words = ["git", "grep", "-lE", "import (pyorbslam3|orb_slam3)|from pyorbslam3", "--", "*.py"]
    found = subprocess.run(words, cwd=root, capture_output=True, text=True).stdout.split()
    assert set(found) <= {"docs/examples/orb_slam3.py", "tests/docs/test_orb_slam3_example.py"}
