"""The whole backend of the page on extending: it tracks, and its maps are saved and opened."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ms_slam_env import slam
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.sequences import HandheldPath, Sequence, open_sequence

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extending.md"
NAME = "tiny_slam:TinySlam"


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The class of the page, as a user has it: in a module of the current folder."""
    section = PAGE.read_text(encoding="utf-8").partition("## A whole SLAM backend")[2]
    source = re.findall(r"^```python\n(.*?)^```", section, re.MULTILINE | re.DOTALL)[0]
    (tmp_path / "tiny_slam.py").write_text(source)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return importlib.import_module("tiny_slam").TinySlam


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return open_sequence("living_room:2000", "160x120", path=HandheldPath(30))


def test_it_tracks_and_maps(tiny: Any, sequence: Sequence) -> None:
    run = run_sequence(slam.make(NAME, sequence.intrinsics), sequence)
    assert run.lost == 0
    resting = np.repeat(sequence.poses[:1], len(run), axis=0)
    error_m, rest_m = (ate_rmse(poses, sequence.poses) for poses in (run.estimates, resting))
    assert error_m < 0.3 * rest_m
    views = run.backend.predict(run.estimates[-1:])
    truth = sequence.frames[len(run) - 1].depth
    both = (truth > 0) & (views.depth[0] > 0)
    assert both.mean() > 0.5
    assert np.median(np.abs(views.depth[0] - truth)[both]) < 0.05


def test_its_state_is_complete(tiny: Any, sequence: Sequence) -> None:
    one, other = (slam.make(NAME, sequence.intrinsics) for _ in range(2))
    run_sequence(one, [sequence.frames[k] for k in range(10)])
    other.set_state(one.get_state())
    for k in range(10, 15):
        expected = one.track(sequence.frames[k]).T_world_camera
        np.testing.assert_array_equal(other.track(sequence.frames[k]).T_world_camera, expected)


def test_its_maps_are_opened_where_it_is_named(tiny: Any, sequence: Sequence) -> None:
    one = slam.make(NAME, sequence.intrinsics, features=300)
    run_sequence(one, [sequence.frames[k] for k in range(10)])
    one.save("map.npz")
    with pytest.raises(InputError, match=r"map of 'tiny_slam:TinySlam', none of surfel, .*as well"):
        slam.open_map("map.npz")
    with pytest.raises(InputError, match="made with option 'features' = '300': give it again"):
        slam.open_map("map.npz", backend=NAME)
    with pytest.raises(InputError, match="holds a map of TinySlam, not of OdometrySlam"):
        slam.make("odometry", sequence.intrinsics).load("map.npz")
    for backend in (NAME, tiny):
        later = slam.open_map("map.npz", backend=backend, features=300)
        np.testing.assert_array_equal(later.surface_points(), one.surface_points())
        assert later.track(sequence.frames[9]).tracking_ok


def test_the_commands_of_the_page_run(tiny: Any, capsys: pytest.CaptureFixture[str]) -> None:
    run = ["run", "living_room:2000:handheld,frames=5"]
    named = ["--backend", NAME]
    assert main([*run, *named, "--map-out", "map.npz", "--out", "a"]) == 0
    capsys.readouterr()
    assert main([*run, "--map-in", "map.npz", "--out", "b"]) == 2
    assert "name that backend as well, as in --backend module:Class" in capsys.readouterr().err
    assert main([*run, *named, "--map-in", "map.npz", "--out", "b"]) == 0


def test_what_a_file_cannot_hold_is_said_before_any_frame(
    tiny: Any, sequence: Sequence, capsys: pytest.CaptureFixture[str]
) -> None:
    tiny.get_state = lambda self: {"marks": {3: np.eye(4)}, "seen": set()}
    backend = slam.make(NAME, sequence.intrinsics)
    with pytest.raises(InputError, match=r"state.marks is a mapping with the key 3, not text"):
        backend.save("map.npz")
    tiny.get_state = lambda self: {"seen": [np.eye(4), {"x": {1, 2}}]}
    run = ["run", "living_room:2000:handheld,frames=5", "--backend", NAME, "--out", "a"]
    assert main([*run, "--map-out", "map.npz"]) == 2
    assert "a map cannot be saved: state.seen[1].x is a set; a file" in capsys.readouterr().err
    assert not Path("a/trajectory.incomplete.txt").exists()
    tiny.get_state = lambda self: None
    with pytest.raises(InputError, match="its get_state returned a NoneType, not a mapping"):
        backend.save("map.npz")

    def missing(self: Any) -> dict[str, Any]:
        raise NotImplementedError

    tiny.get_state = missing
    with pytest.raises(InputError, match="TinySlam cannot be saved: its get_state is not impl"):
        backend.save("map.npz")
