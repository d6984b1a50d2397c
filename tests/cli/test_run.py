"""``ms-slam run``: what it writes, and what an unfinished run leaves."""

import json
import os
import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from ms_slam_env.camera import xtion
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.evaluation.run_to_folder import run_to_folder
from ms_slam_env.geometry import look_at
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.metrics.registry import RESULTS_VERSION
from ms_slam_env.sequences import open_sequence, read_trajectory, render_sequence, write_trajectory
from ms_slam_env.sequences.recording import Recording

FRAMES = 8


@pytest.fixture(scope="module")
def sequence(box_scene, tmp_path_factory):
    """A short sequence of the box scene in the TUM layout, 80x60."""
    folder = tmp_path_factory.mktemp("sequences") / "box"
    intrinsics = xtion("80x60")
    eye = box_scene.sample_start(np.random.default_rng(0))[:3, 3]
    low, high = box_scene.mesh.vertices.min(0), box_scene.mesh.vertices.max(0)
    middle = (low + high) / 2
    poses = np.stack([look_at(eye + 0.01 * k * np.eye(3)[0], middle) for k in range(FRAMES)])
    rendered = render_sequence(box_scene, poses, intrinsics)
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    listings = {"rgb": [], "depth": []}
    for index, frame in enumerate(rendered.frames):
        Image.fromarray(frame.color).save(folder / f"rgb/{index}.png")
        values = np.rint(frame.depth * 5000).astype(np.uint16)
        Image.fromarray(values).save(folder / f"depth/{index}.png")
        for name, lines in listings.items():
            lines.append(f"{frame.timestamp:.6f} {name}/{index}.png")
    for name, lines in listings.items():
        (folder / f"{name}.txt").write_text("\n".join(lines))
    i = intrinsics
    (folder / "intrinsics.txt").write_text(f"{i.fx} {i.fy} {i.cx} {i.cy} {i.width} {i.height}")
    times = [frame.timestamp for frame in rendered.frames]
    write_trajectory(folder / "groundtruth.txt", times, poses)
    return folder


def test_a_run_of_several_submaps_says_which_frame_is_in_which(box_scene, tmp_path):
    path = _turning(np.concatenate([np.arange(0, 46, 3), np.arange(130, 30, -3)]))
    sequence = render_sequence(box_scene, path, xtion("160x120"), "kinect", 0)
    params = {"submaps": "atlas", "max_surfels": 120_000, "submap_rules": {"after": 3}}
    result = run_to_folder(sequence, "surfel", params, tmp_path)
    assert (result["submaps"], result["joined_submaps"], result["unjoined_share"]) == (2, 1, 0)
    assert result["lost_frames"] == 2
    assert result["submap_ate_m"] <= result["joined_ate_m"] + 1e-9  # one submap in the end
    assert result["joined_ate_m"] < 0.01
    assert result["ate_m"] > 0.05  # of the poses as they were given, before the joint
    rows = [line.split(",") for line in (tmp_path / "submaps.csv").read_text().splitlines()]
    assert rows[0] == ["timestamp", "submap", "joined_to", "sigma_m", "sigma_deg"]
    own, now = (np.array([int(row[k]) for row in rows[1:]]) for k in (1, 2))
    assert own[:16].tolist() == now[:16].tolist() == [0] * 16
    assert own[16:18].tolist() == [-1, -1]
    assert own[18] == 1
    assert not now[18:].any()
    written = json.loads((tmp_path / "metrics.json").read_text())
    assert "Submaps" in [table["title"] for table in written["tables"]]
    (chart,) = [chart for chart in written["charts"] if chart["name"] == "submaps"]
    assert [line["name"] for line in chart["panels"][0]["series"]] == ["truth", "submap 0"]


def _turning(degrees):
    """Poses (N, 4, 4) of a camera that turns, stepping aside a little."""
    eyes = np.array([-0.8, -0.8, 1.2]) + np.outer(degrees, [0.002, 0.003, 0.0])
    angles = np.radians(degrees)
    aims = np.stack([np.cos(angles), np.sin(angles), np.full(len(angles), -0.35)], axis=1)
    return np.stack([look_at(eye, eye + aim) for eye, aim in zip(eyes, aims, strict=True)])


def test_writes_trajectory_map_and_metrics(sequence, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["run", str(sequence), "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "frames.csv",
        "groundtruth.txt",
        "map.ply",
        "metrics.json",
        "trajectory.txt",
    ]
    times, poses = read_trajectory(out / "trajectory.txt")
    _, truth = read_trajectory(sequence / "groundtruth.txt")
    written = json.loads((out / "metrics.json").read_text())
    assert written["complete"]
    steps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    assert written["path_m"] == pytest.approx(steps.sum(), rel=1e-6)
    assert (written["kind"], written["results_version"]) == ("run", RESULTS_VERSION)
    assert [chart["name"] for chart in written["charts"]] == ["path", "error", "alignment", "cost"]
    page = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text(encoding="utf-8")
    named = re.findall(r"`(\w+)`", re.findall(r"`metrics.json` \| (.*) and more", page)[0])
    assert named
    assert set(named) <= written.keys()
    path = written["charts"][0]
    drawn = {line["name"]: line for line in path["panels"][0]["series"]}
    for axis in "xy":  # aligned as a whole, the two have one centre
        assert np.mean(drawn["estimate"][axis]) == pytest.approx(
            np.mean(drawn["truth"][axis]), abs=1e-9
        )
    assert path["caption"].endswith("After SE(3) alignment with the truth.")
    assert [table["title"] for table in written["tables"]] == ["Frames and trajectory", "Cost"]
    assert (written["frames"], written["lost_frames"], len(times)) == (FRAMES, 0, FRAMES)
    assert written["ate_m"] == pytest.approx(ate_rmse(poses, truth), abs=1e-6)
    assert written["ate_m"] < 0.01
    np.testing.assert_allclose(poses[0], truth[0], atol=1e-6)
    assert 0 < written["ext_ms_median"] <= written["ext_ms_p95"] <= written["ext_ms_max"]
    assert written["ene_source"].startswith("cpu: ")
    header, *rows = (out / "frames.csv").read_text().splitlines()
    assert header == (
        "timestamp,tracking_ok,ext_ms,cpu_ms,mem_mb,ene_j,"
        "inlier_fraction,overlap,residual_m,degenerate_directions,reason,refusal"
    )
    assert written["ate_tracked_m"] == written["ate_m"]
    assert written["tracked_share"] == 1
    assert written["lost_reasons"] == []
    assert [float(row.split(",")[0]) for row in rows] == pytest.approx(times)
    assert np.mean([float(row.split(",")[2]) for row in rows]) == pytest.approx(
        written["ext_ms"], abs=1e-3
    )
    cloud = trimesh.load(out / "map.ply")
    assert len(cloud.vertices) > 1000
    raw = cloud.metadata["_ply_raw"]["vertex"]["properties"]
    assert {"red", "nx", "ny", "nz", "radius", "confidence"} <= set(raw)
    said = capsys.readouterr()
    assert "ate_m" in said.out
    assert f"written: {out}/metrics.json, trajectory.txt, groundtruth.txt, map.ply" in said.err


def test_a_scale_that_is_not_that_of_the_truth_is_complained_about(sequence, tmp_path, capsys):
    folder = shutil.copytree(sequence, tmp_path / "box")
    times, poses = read_trajectory(folder / "groundtruth.txt")
    poses[:, :3, 3] *= 5
    write_trajectory(folder / "groundtruth.txt", times, poses)
    assert main(["run", str(folder), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert "box: the tracked poses do not fit the true ones: the estimate extends over 0.0" in said
    times_it = re.search(r"; times (\S+) it fits, as with a wrong depth scale", said)
    assert float(times_it[1]) == pytest.approx(5, rel=0.1)


@pytest.mark.parametrize(("map_out", "code"), [(True, 2), (False, 0)])
def test_a_map_that_cannot_be_saved_is_refused_at_its_first_frame(
    map_out, code, sequence, tmp_path, capsys, monkeypatch
):
    (tmp_path / "last_frame.py").write_text(
        "from ms_slam_env.slam.surfel import SurfelSlam\n"
        "class LastFrame(SurfelSlam):\n"
        "    last = None\n"
        "    def get_state(self): return {**super().get_state(), 'last': self.last}\n"
        "    def track(self, frame, *given):\n"
        "        self.last = frame\n"
        "        return super().track(frame, *given)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    options = ["--map-out", str(tmp_path / "map.npz")] * map_out
    options += ["--backend", "last_frame:LastFrame", "--out", str(tmp_path / "out")]
    assert main(["run", str(sequence), *options]) == code
    assert ("state.last is a RGBDFrame" in capsys.readouterr().err) == map_out
    written = json.loads((tmp_path / "out/metrics.json").read_text())
    assert written["frames"] == (1 if map_out else FRAMES)


@pytest.mark.parametrize(("rows", "said"), [(2, "are measured"), (1, "need two and are not meas")])
def test_of_how_many_frames_the_errors_are_is_said(rows, said, sequence, tmp_path, capsys):
    folder = shutil.copytree(sequence, tmp_path / "box")
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(lines[: rows + 1]))
    assert main(["run", str(folder), "--backend", "odometry", "--out", str(tmp_path / "o")]) == 0
    out, err = capsys.readouterr()
    assert f"true poses       {rows} of {FRAMES} frames" in out
    assert re.search(f"{rows} of {FRAMES} frames have a true pose; errors {said}", err)
    written = json.loads((tmp_path / "o/metrics.json").read_text())
    assert (written["poses"], written["unmatched_poses"]) == (rows, FRAMES - rows)
    assert ("ate_m" in written) == (rows > 1)
    table = written["tables"][0]
    assert {"poses", "unmatched_poses"} <= {column["name"] for column in table["columns"]}
    opened = open_sequence(folder)
    with (
        pytest.raises(InputError)
        if rows < 2
        else pytest.warns(
            InputWarning, match=f"2 of {FRAMES} frames have a true pose; the others are left out"
        )
    ):
        assert len(opened.where_known()) == 2


def test_a_backend_that_closes_loops_writes_the_final_poses_too(sequence, tmp_path):
    out = tmp_path / "out"
    command = ["run", str(sequence), "--out", str(out), "--params", "loop_closure=deformation"]
    assert main(command) == 0
    times, final = read_trajectory(out / "trajectory.corrected.txt")
    first_times, first = read_trajectory(out / "trajectory.txt")
    np.testing.assert_array_equal(times, first_times)
    np.testing.assert_allclose(final, first, atol=1e-6)  # no loop in eight frames
    written = json.loads((out / "metrics.json").read_text())
    assert written["final_ate_m"] == pytest.approx(written["ate_m"], abs=1e-9)


def test_a_configuration_file_says_how_to_run(sequence, tmp_path):
    out = tmp_path / "out"
    file = tmp_path / "slam.yaml"
    file.write_text("slam_config: {depth_cutoff_m: 2.5, icp_rgb_weight: 0.2}\nkeep_every: 3\n")
    command = ["run", str(sequence), "--config", str(file), "--params", "icp_rgb_weight=0.3"]
    assert main([*command, "--out", str(out)]) == 0
    written = json.loads((out / "metrics.json").read_text())
    assert written["params"] == {"depth_cutoff_m": 2.5, "icp_rgb_weight": 0.3}
    assert (written["backend"], written["keep_every"]) == ("surfel", 3)
    times, _ = read_trajectory(out / "trajectory.txt")
    true_times, _ = read_trajectory(sequence / "groundtruth.txt")
    np.testing.assert_allclose(times, true_times[::3])


def test_a_run_that_fails_keeps_the_trajectory_so_far(sequence, tmp_path, capsys):
    broken = tmp_path / "broken"
    shutil.copytree(sequence, broken)
    image = broken / "depth/5.png"
    image.write_bytes(image.read_bytes()[:100])
    out = tmp_path / "out"
    assert main(["run", str(broken), "--out", str(out)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert "depth.txt:6" in lines[-1]
    assert "5.png" in lines[-1]
    assert not (out / "trajectory.txt").exists()
    times, _ = read_trajectory(out / "trajectory.incomplete.txt")
    assert len(times) == 5
    written = json.loads((out / "metrics.json").read_text())
    assert not written["complete"]
    assert written["frames"] == 5
    assert "5.png" in written["error"]


@pytest.mark.skipif(os.name != "posix", reason="sends a signal")
def test_an_interrupted_run_keeps_the_trajectory_so_far(sequence, tmp_path, capsys, monkeypatch):
    decode = Recording.frame

    def frame(recording, index):
        if index == 4:
            so_far, _ = read_trajectory(out / "trajectory.incomplete.txt")
            assert len(so_far) == 4  # on disk already: a kill would not lose it either
            os.kill(os.getpid(), signal.SIGTERM)
        return decode(recording, index)

    out = tmp_path / "out"
    assert main(["run", str(sequence), "--out", str(out)]) == 0
    whole = (out / "trajectory.txt").read_text().splitlines()
    monkeypatch.setattr(Recording, "frame", frame)
    assert main(["run", str(sequence), "--out", str(out)]) == 143
    last = capsys.readouterr().err.strip().splitlines()[-1]
    said = f"ms-slam: interrupted by SIGTERM; 4 of {len(whole) - 1} frames are kept in {out}"
    assert last == said
    # Nothing of the earlier, finished run is left to be taken for this one's.
    assert sorted(path.name for path in out.iterdir()) == [
        "frames.csv",
        "metrics.json",
        "trajectory.incomplete.txt",
    ]
    assert (out / "trajectory.incomplete.txt").read_text().splitlines() == whole[:5]
    assert len((out / "frames.csv").read_text().splitlines()) == 1 + 4
    written = json.loads((out / "metrics.json").read_text())
    assert (written["complete"], written["frames"]) == (False, 4)
    assert written["error"] == "interrupted by SIGTERM"


def test_says_what_registration_it_assumes(sequence, tmp_path, capsys):
    folder = tmp_path / "seq-01"
    folder.mkdir()
    for index in range(3):
        depth = np.asarray(Image.open(sequence / f"depth/{index}.png")) // 5
        Image.fromarray(depth.astype(np.uint16)).save(folder / f"frame-00000{index}.depth.png")
        shutil.copy(sequence / f"rgb/{index}.png", folder / f"frame-00000{index}.color.png")
    shutil.copy(sequence / "intrinsics.txt", folder)
    out = tmp_path / "out"
    assert main(["run", str(folder), "--out", str(out)]) == 0
    assert "colour brought into the depth camera: focal ratio 0.8974, baseline 2.5 cm" in (
        capsys.readouterr().err
    )
    assert "focal ratio" in json.loads((out / "metrics.json").read_text())["registration"]
    assert main(["run", str(folder), "--register", "False", "--out", str(out)]) == 0
    assert "focal ratio" not in capsys.readouterr().err
    assert json.loads((out / "metrics.json").read_text())["registration"] is None


def test_manages_frames(sequence, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--frame-management", "regular,every=2"]
    assert main(["run", str(sequence), *options, "--out", str(out)]) == 0
    assert f"processed_frames {FRAMES // 2}" in capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frame_management"] == {
        "name": "regular",
        "every": 2,
        "max_skip": 10,
        "pose": "constant-velocity",
    }
    times, _ = read_trajectory(out / "trajectory.txt")
    assert len(times) == metrics["frames"] == FRAMES
