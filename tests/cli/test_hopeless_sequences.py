"""Commands over several sequences say so where one shows nothing or is lost from end to end."""

import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from ms_slam_env.benchmark.rows import lost_runs
from ms_slam_env.cli import main
from ms_slam_env.sequences import open_sequence


@pytest.fixture
def recording(tmp_path):
    """Writes a recording of six frames with true poses, whose depth is as given."""

    def write(name, depths):
        folder = tmp_path / name
        for kind in ("depth", "rgb"):
            (folder / kind).mkdir(parents=True)
        poses = []
        for k, depth in enumerate(depths):
            Image.fromarray(depth.astype(np.uint16)).save(folder / f"depth/{k}.png")
            Image.new("RGB", depth.shape[::-1]).save(folder / f"rgb/{k}.png")
            poses.append(f"{k / 30:.6f} {0.01 * k} 0 0 0 0 0 1")
        (folder / "intrinsics.txt").write_text("71 71 39.5 29.5 80 60 1000")
        (folder / "times.txt").write_text("\n".join(line.split()[0] for line in poses))
        (folder / "groundtruth.txt").write_text("\n".join(poses))
        assert open_sequence(folder, with_truth=True).timestamps[1] == pytest.approx(
            1 / 30, abs=1e-3
        )
        return folder

    return write


@pytest.fixture
def blank(recording):
    return recording("blank", [np.zeros((60, 80))] * 6)


@pytest.fixture
def jumping(recording):
    """Hardly a reading, each time elsewhere: nothing can be aligned."""
    depths = [np.zeros((60, 80)) for _ in range(6)]
    for k, depth in enumerate(depths):
        depth[10 * k :][:5, :5] = 1000
    return recording("jumping", depths)


COMMANDS = {
    "run": "run {} --backend odometry",
    "compare": "compare --sequences {} --backends odometry --image-sizes 80x60 --workers 1",
    "explore": "explore --sequences {} --parameters keyframe_deg=0:20 --config {config} "
    "--image-size 80x60 --trials 2",
}


def run(command, folder, tmp_path):
    (tmp_path / "c.yaml").write_text("slam: odometry\n")
    words = (
        {**COMMANDS, "divergence": "divergence {}"}[command]
        .format(folder, config=tmp_path / "c.yaml")
        .split()
    )
    return main([*words, "--out", str(tmp_path / "out")])


@pytest.mark.parametrize(
    ("command", "code"), [("compare", 1), ("explore", 2), ("run", 2), ("divergence", 2)]
)
def test_a_sequence_without_depth_is_refused(command, code, blank, tmp_path, capsys):
    assert run(command, blank, tmp_path) == code
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert "error: " in last
    assert "sequence blank: no frame has a depth reading" in last


@pytest.mark.parametrize("command", COMMANDS)
def test_a_sequence_that_is_lost_throughout_is_a_failure(command, jumping, tmp_path, capsys):
    assert run(command, jumping, tmp_path) == 1
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert "ms-slam: error: " in last
    assert (
        re.search(r"lost in [56] of 6 frames", last)
        or "tracking lost in 100 % of the frames" in last
    )
    (name,) = {"results.json", "explore.json", "metrics.json"} & {
        p.name for p in (tmp_path / "out").iterdir()
    }
    assert json.loads((tmp_path / "out" / name).read_text())["kind"]


def test_what_a_recording_lacks_is_said(blank, tmp_path, capsys):
    shutil.rmtree(blank / "rgb")
    (blank / "groundtruth.txt").unlink()
    assert run("run", blank, tmp_path) == 2
    said = capsys.readouterr().err
    assert "no colour: SLAM has depth alone" in said
    assert "no true trajectory: errors are not measured" in said
    assert not list((tmp_path / "out").rglob("*"))


def test_what_counts_as_lost_throughout():
    spec = {"sequence": "s", "backend": "b"}

    def complaints(frames, lost):
        result = {"frames": frames, "lost_share": lost / frames}
        return lost_runs([{"spec": spec, "result": result, "error": None}])

    assert complaints(90, 88) == []
    assert complaints(90, 89) == ["sequence s, backend b: lost in 89 of 90 frames"]
    assert complaints(926, 926) == ["sequence s, backend b: lost in 926 of 926 frames"]
    assert complaints(1, 0) == []
    assert lost_runs([{"spec": spec, "result": None, "error": "no"}]) == []


def test_a_map_is_not_judged_by_a_sequence_without_depth(blank, tmp_path, capsys):
    cloud = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    (tmp_path / "map.ply").write_text(f"{cloud}end_header\n0 0 1\n0 1 1\n1 0 1\n")
    words = ["--map", str(tmp_path / "map.ply"), "--true-map", str(blank)]
    assert main(["evaluate", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "no frame has a depth reading" in line


def test_a_trajectory_without_a_tracked_frame_is_refused(blank, tmp_path, capsys):
    truth = blank / "groundtruth.txt"
    times = [line.split()[0] for line in truth.read_text().splitlines()]
    frames = "\n".join(["timestamp,tracking_ok", *(f"{time},0" for time in times)])
    (tmp_path / "frames.csv").write_text(frames)
    words = [str(truth), str(truth), "--frames", str(tmp_path / "frames.csv")]
    assert main(["evaluate", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "frames.csv" in line
