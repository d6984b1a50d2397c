"""``ms-slam run``: why frames were lost, maps of several sessions, meshes."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from ms_slam_env import slam
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.run_sequence import SequenceRun
from ms_slam_env.evaluation.run_to_folder import run_to_folder
from ms_slam_env.geometry import look_at
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.sequences import Sequence, read_trajectory, render_sequence
from ms_slam_env.slam.frame_selection import make_config

PARAMS = {"max_surfels": 60_000}


@pytest.fixture(scope="module")
def sequence(box_scene):
    eyes = np.array([-0.8, -0.8, 1.2]) + np.outer(np.arange(12), [0.02, 0.01, 0.0])
    poses = np.stack([look_at(eye, [1.2, 0.1, 0.5]) for eye in eyes])
    rendered = render_sequence(box_scene, poses, xtion("160x120"), "kinect", 0)
    return Sequence(tuple(rendered.frames), poses, rendered.intrinsics, "box")


def _with_holes(sequence, numbers):
    """The same with some frames black and without depth."""
    frames = list(sequence.frames)
    for number in numbers:
        nothing = np.zeros_like(frames[number].color), np.zeros_like(frames[number].depth)
        frames[number] = RGBDFrame(*nothing, frames[number].timestamp)
    return replace(sequence, frames=tuple(frames))


@pytest.fixture(scope="module")
def holed_run(sequence, tmp_path_factory):
    """A sequence with two black frames, the folder of a run over it, and the run's result."""
    folder = tmp_path_factory.mktemp("holed")
    holed = _with_holes(sequence, (6, 7))
    return holed, folder, run_to_folder(holed, "surfel", PARAMS, folder)


def test_lost_frames_say_why(holed_run):
    holed, folder, result = holed_run
    assert result["lost_frames"] == 2
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    own = SequenceRun(slam.make("surfel", holed.intrinsics, **PARAMS), holed)
    results = [step.result for step in own]
    assert [row["reason"] for row in rows] == [result.reason for result in results]
    assert rows[6]["reason"]
    assert [row["refusal"] for row in rows] == [result.refusal for result in results]
    for key in ("inlier_fraction", "overlap", "degenerate_directions"):
        expected = [getattr(result, key) for result in results]
        assert [float(row[key]) for row in rows] == pytest.approx(expected, abs=1e-3)
    # The picture looks at the map in the middle of the run, and leaves no trace in it.
    _, poses = read_trajectory(folder / "trajectory.txt")
    np.testing.assert_allclose(poses, own.estimates, atol=1e-6)
    (line,) = result["lost_reasons"]
    assert line.startswith(f"2 frames, the first 6: {rows[6]['reason']}")
    written = json.loads((folder / "metrics.json").read_text())
    assert "Why frames were lost" in [table["title"] for table in written["tables"]]
    assert (folder / "refused.png").read_bytes()[1:4] == b"PNG"


def test_the_error_of_tracked_frames_stands_beside_the_headline(sequence, holed_run):
    _, folder, result = holed_run
    _, poses = read_trajectory(folder / "trajectory.txt")
    ok = np.isin(np.arange(12), (6, 7), invert=True)
    assert result["tracked_share"] == pytest.approx(10 / 12)
    assert result["ate_tracked_m"] == pytest.approx(
        ate_rmse(poses[ok], sequence.poses[ok]), abs=1e-6
    )
    assert result["ate_m"] > 1.5 * result["ate_tracked_m"]


def test_a_run_without_loss_draws_no_refused_frame(sequence, holed_run, tmp_path):
    shutil.copytree(holed_run[1], tmp_path, dirs_exist_ok=True)
    assert (tmp_path / "refused.png").exists()
    run_to_folder(sequence, "surfel", PARAMS, tmp_path)
    assert not (tmp_path / "refused.png").exists()


@pytest.mark.parametrize("managed", [False, True])
def test_a_second_session_goes_on_in_the_map_of_the_first(sequence, tmp_path, managed):
    selection = make_config(name="regular", every=2) if managed else None
    params = {**PARAMS, "loop_closure": "deformation"}
    stored = tmp_path / "map.npz"
    first = sequence.picked(np.arange(8))
    run_to_folder(first, "surfel", params, tmp_path / "a", map_out=stored)
    second = sequence.picked(np.arange(5, 12))
    result = run_to_folder(second, "surfel", params, tmp_path / "b", None, selection, map_in=stored)
    assert result["lost_frames"] == 0
    _, poses = read_trajectory(tmp_path / "b/trajectory.corrected.txt")
    assert len(poses) == 7
    errors_m = np.linalg.norm(poses[:, :3, 3] - second.poses[:, :3, 3], axis=1)
    assert errors_m.max() < 0.025  # a dropped frame is at rest before any motion is known


def test_the_command_takes_backend_and_parameters_from_the_map(tmp_path, capsys):
    stored = tmp_path / "map.npz"
    command = ["run", "table:2000", "--image-size", "80x60"]
    backend = slam.make("surfel", xtion("80x60"), max_surfels=60_000, icp_rgb_weight=0.3)
    backend.save(stored)
    assert main([*command, "--map-in", str(stored), "--backend", "sparse"]) == 2
    assert "holds a map of surfel, not of sparse" in capsys.readouterr().err
    assert main([*command, "--map-in", str(tmp_path / "none.npz")]) == 2
    assert "No such file" in capsys.readouterr().err


def test_a_second_session_takes_the_image_size_of_the_map(tmp_path, capsys):
    """By default; another size, camera or aspect is one line that says what differs."""
    stored, wide = tmp_path / "map.npz", tmp_path / "wide.npz"
    sequence = ["run", "table:2000:handheld,frames=3", "--out", str(tmp_path / "out")]
    assert main([*sequence, "--image-size", "80x60", "--map-out", str(stored)]) == 0
    assert main([*sequence, "--map-in", str(stored)]) == 0  # rendered at 160x120 otherwise
    capsys.readouterr()
    assert main([*sequence, "--image-size", "160x120", "--map-in", str(stored)]) == 2
    assert capsys.readouterr().err.endswith(
        f"{stored} holds a map made from images of 80x60, not 160x120; "
        "continue at --image-size 80x60\n"
    )
    slam.make("surfel", Intrinsics(70, 71.2875, 40, 29.5, 80, 60)).save(stored)
    assert main([*sequence, "--map-in", str(stored)]) == 2
    assert capsys.readouterr().err.endswith(
        "holds a map of another camera: fx 70, not 71.2875; cx 40, not 39.5\n"
    )
    folder = tmp_path / "recording"
    assert main(["generate", "--scene", "table", "--path.frames", "2", "--image-size", "80x60",
                 "--out", str(folder)]) == 0  # fmt: skip
    slam.make("surfel", xtion("80x40")).save(wide)
    capsys.readouterr()
    assert main(["run", str(folder), "--map-in", str(wide)]) == 2
    said = capsys.readouterr().err
    assert "images of 80x60 cannot be reduced to 80x40" in said
    assert said.endswith(f"({wide} was made at 80x40, which is kept)\n")


def test_sparse_without_colour_is_refused(sequence):
    class Colourless(Sequence):
        has_color = False

    pytest.importorskip("gtsam", reason="GTSAM is not installed", exc_type=ImportError)
    black = Colourless(sequence.frames, sequence.poses, sequence.intrinsics, "black")
    backend = slam.make("sparse", sequence.intrinsics)
    with pytest.raises(InputError, match="black has no colour, without which SparseSlam"):
        SequenceRun(backend, black)
    SequenceRun(slam.make("surfel", sequence.intrinsics, **PARAMS), black)


def test_a_mesh_lies_on_the_surface(sequence, box_scene, tmp_path):
    pytest.importorskip("open3d", reason="Open3D is not installed", exc_type=ImportError)
    run_to_folder(sequence, "surfel", PARAMS, tmp_path, mesh=True)
    mesh = trimesh.load(tmp_path / "mesh.ply")
    assert len(mesh.faces) > 1000
    assert mesh.visual.kind == "vertex"
    truth = trimesh.Trimesh(box_scene.mesh.vertices, box_scene.mesh.faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, 2000, seed=0)
    true_points, _ = trimesh.sample.sample_surface(truth, 400_000, seed=0)  # 1 cm apart
    distance, _ = cKDTree(true_points).query(points)
    assert np.median(distance) < 0.01
    assert np.quantile(distance, 0.95) < 0.05
