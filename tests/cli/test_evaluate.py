"""``ms-slam evaluate``: trajectories against evo, gaps, pieces; maps as clouds and meshes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.units import Unit
from evo.main_ape import ape
from evo.tools import file_interface
from PIL import Image

from ms_slam_env import metrics
from ms_slam_env.camera import xtion
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_files import MapOptions, evaluate_maps
from ms_slam_env.evaluation.run_files import write_ply
from ms_slam_env.evaluation.trajectory_files import TrajectoryOptions, complaints
from ms_slam_env.evaluation.trajectory_measures import absolute_key, evaluate_files, statistic_keys
from ms_slam_env.geometry import invert, make_pose, se3_exp, so3_exp, transform_points
from ms_slam_env.sequences import read_trajectory, write_trajectory

STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
COUNT = 120


def truth_path() -> tuple[np.ndarray, np.ndarray]:
    t = 0.05 * np.arange(COUNT)
    places = np.stack([np.sin(t), np.cos(1.3 * t), 0.2 * t], axis=1)
    return t, np.stack(
        [make_pose(so3_exp([0.1 * x, 0.2 * x, 0.3 * x]), p) for x, p in zip(t, places, strict=True)]
    )


def write_pair(
    folder: Path, scale: float = 1.0, noise: float = 0.01, keep: np.ndarray | None = None
) -> list[str]:
    """Paths of an estimate in a world and scale of its own, some poses left out, and the truth."""
    t, truth = truth_path()
    rng = np.random.default_rng(0)
    estimate = se3_exp([1, 2, 3, 0.3, -0.2, 0.1]) @ truth
    estimate = np.stack([T @ se3_exp(rng.normal(0, noise, 6)) for T in estimate])
    estimate[:, :3, 3] *= scale
    kept = np.ones(COUNT, dtype=bool) if keep is None else keep
    write_trajectory(folder / "estimate.txt", t[kept] + 0.003, estimate[kept])
    write_trajectory(folder / "truth.txt", t, truth)
    return [str(folder / "estimate.txt"), str(folder / "truth.txt")]


def evaluate(arguments: list[str], out: Path) -> dict[str, Any]:
    assert main(["evaluate", *arguments, "--out", str(out)]) == 0
    return json.loads((out / "evaluation.json").read_text())


def one_line(text: str) -> str:
    lines = text.strip().splitlines()
    assert len(lines) == 1, text
    return lines[0]


@pytest.mark.parametrize("align", ["se3", "sim3", "origin", "none"])
@pytest.mark.parametrize(
    ("options", "unit", "delta", "every"),
    [
        ({}, Unit.frames, 1, True),
        ({"delta": 6, "pairs": "consecutive"}, Unit.frames, 6, False),
        ({"delta": 0.5, "delta_unit": "m"}, Unit.meters, 0.5, True),
    ],
)
def test_statistics_are_those_of_evo(
    tmp_path: Path, align: str, options: dict, unit: Unit, delta: float, every: bool
) -> None:
    pair = write_pair(tmp_path, scale=1.5 if align == "sim3" else 1.0)
    chosen = TrajectoryOptions(align, tolerance=0.2, **options)
    result = evaluate_files(*map(Path, pair), chosen)
    truth, estimate = sync.associate_trajectories(
        *(file_interface.read_tum_trajectory_file(pair[k]) for k in (1, 0)), max_diff=0.02
    )
    if align == "origin":
        estimate.align_origin(truth)
    elif align != "none":
        estimate.align(truth, correct_scale=align == "sim3")
    assert result["scale"] == pytest.approx(1 / 1.5 if align == "sim3" else 1.0, abs=0.01)
    relations = {
        "m": evo_metrics.PoseRelation.translation_part,
        "rad": evo_metrics.PoseRelation.rotation_angle_rad,
    }
    for name, relation in relations.items():
        ape = evo_metrics.APE(relation)
        rpe = evo_metrics.RPE(relation, delta, unit, 0.2, every, pairs_from_reference=True)
        for key, metric in ((absolute_key(chosen, name), ape), (f"rpe_{name}", rpe)):
            metric.process_data((truth, estimate))
            found = metric.get_all_statistics()
            for statistic, of in zip(STATISTICS, statistic_keys(key), strict=True):
                assert result[of] == pytest.approx(found[statistic], abs=1e-9)


@pytest.mark.parametrize(
    ("options", "flags"),
    [
        (["--align", "origin"], {"align_origin": True}),
        (["--align-first", "30"], {"align": True, "n_to_align": 30}),
        (
            ["--align", "sim3", "--align-first", "30"],
            {"align": True, "correct_scale": True, "n_to_align": 30},
        ),
    ],
)
def test_alignments_are_those_of_evos_command(
    tmp_path: Path, options: list[str], flags: dict[str, Any]
) -> None:
    pair = write_pair(tmp_path, scale=1.5 if "sim3" in options else 1.0)
    result = evaluate([*pair, *options], tmp_path / "out")
    truth, estimate = sync.associate_trajectories(
        *(file_interface.read_tum_trajectory_file(pair[k]) for k in (1, 0)), max_diff=0.02
    )
    found = ape(truth, estimate, evo_metrics.PoseRelation.translation_part, **flags).stats
    name = "ate_origin_m" if "origin" in options else "ate_first_m"
    for statistic, of in zip(STATISTICS, statistic_keys(name), strict=True):
        assert result[of] == pytest.approx(found[statistic], abs=1e-9)


def test_the_alignment_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = write_pair(tmp_path)
    out = tmp_path / "out"
    result = evaluate([*pair, "--align", "yaw", "--align-first", "40"], out)
    assert "alignment yaw by the first 40 poses" in capsys.readouterr().out
    assert "alignment yaw by the first 40 poses" in (out / "table.md").read_text()
    assert (result["config"]["align"], result["config"]["align_first"]) == ("yaw", 40)
    upright = evaluate([*pair, "--align", "yaw"], out)
    estimate, truth = (read_trajectory(Path(path))[1] for path in pair)
    assert upright["ate_yaw_m"] == pytest.approx(metrics.ate_rmse(estimate, truth, "yaw"))
    assert "ate_m" not in upright


def test_files_and_options_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = write_pair(tmp_path)
    out = tmp_path / "out"
    options = ["--segments", "4", "--delta", "1.0", "--delta-unit", "s"]
    before = [Path(path).read_bytes() for path in pair]
    result = evaluate([*pair, *options], out)
    evaluate(pair, tmp_path)  # the results may lie beside the files
    assert [Path(path).read_bytes() for path in pair] == before
    assert sorted(path.name for path in out.iterdir()) == [
        "evaluation.estimate.txt",
        "evaluation.json",
        "evaluation.truth.txt",
        "table.md",
        "trajectory.png",
    ]
    assert (out / "trajectory.png").stat().st_size > 10_000
    config = result["config"]
    assert (config["delta"], config["delta_unit"], config["max_difference_s"]) == (1, "s", 0.02)
    assert (result["kind"], len(result["tables"]), len(result["charts"])) == ("evaluation", 5, 1)
    assert result["provenance"]["versions"]["numpy"] == np.__version__
    assert f"{result['rpe_m']:.6f}" in capsys.readouterr().out
    _, aligned = read_trajectory(out / "evaluation.estimate.txt")
    _, true = read_trajectory(out / "evaluation.truth.txt")
    ate = metrics.ate_rmse(aligned, true, "none")
    assert ate == pytest.approx(result["ate_m"], abs=1e-8)
    assert (
        result["rpe_m"]
        == evaluate_files(*map(Path, pair), TrajectoryOptions(delta=1.0, delta_unit="s"))["rpe_m"]
    )
    # Pieces cover the whole: their errors are those of the whole.
    pieces = result["pieces"]
    assert [piece["poses"] for piece in pieces] == [30, 30, 30, 30]
    squares = [piece["ate_m"] ** 2 for piece in pieces]
    assert np.sqrt(np.mean(squares)) == pytest.approx(result["ate_m"])
    assert max(piece["ate_max_rad"] for piece in pieces) == result["ate_max_rad"]
    shares = [drift["length_m"] / result["path_m"] for drift in result["drift_by_length"]]
    np.testing.assert_allclose(shares, [0.1, 0.2, 0.3, 0.4, 0.5])
    table = (out / "table.md").read_text()
    assert "RMSE of equal pieces" in table
    assert "Drift over lengths of the true path" in table
    assert "0 gaps" in table
    assert result["initialisation_s"] is not None


def test_poses_without_a_true_one_are_counted(tmp_path: Path) -> None:
    pair = write_pair(tmp_path)
    t, truth = truth_path()
    write_trajectory(tmp_path / "truth.txt", t[::3], truth[::3])
    result = evaluate_files(*map(Path, pair))
    assert (result["poses"], result["unmatched_poses"]) == (COUNT // 3, COUNT - COUNT // 3)
    loose = evaluate_files(*map(Path, pair), TrajectoryOptions(max_difference_s=1.0))
    assert loose["poses"] == COUNT // 3  # one true pose belongs to one of the estimate


def test_lengths_of_segments_are_free(tmp_path: Path) -> None:
    pair = write_pair(tmp_path)
    options = TrajectoryOptions(segment_lengths_m=(0.5, 2.0, 500.0))
    result = evaluate_files(*map(Path, pair), options)
    assert [drift["length_m"] for drift in result["drift_by_length"]] == [0.5, 2.0]


def test_of_how_many_poses_the_errors_are_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate, truth = write_pair(tmp_path)
    times, poses = read_trajectory(Path(truth))
    write_trajectory(truth, times[[3, 40, 41]], poses[[3, 40, 41]])
    found = evaluate([estimate, truth], tmp_path / "out")
    said = capsys.readouterr()
    assert said.out.startswith(f"3 of {COUNT} poses have a true one, alignment se3")
    assert f"estimate.txt: only 3 of {COUNT} poses have a true one in {truth}" in said.err
    assert (found["poses"], found["unmatched_poses"]) == (3, COUNT - 3)
    assert f"3 of {COUNT} poses have a true one" in (tmp_path / "out/table.md").read_text()
    assert main(["evaluate", "--runs", estimate, "--truth", truth]) == 0
    assert f"3 of {COUNT} poses have a true one" in capsys.readouterr().out


def test_a_truth_of_another_recording_is_complained_about(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate, truth = write_pair(tmp_path)
    assert main(["evaluate", estimate, truth]) == 0
    assert capsys.readouterr().err == ""
    times, poses = read_trajectory(Path(truth))
    others = {
        "only 33% of the poses": (times + 4.0, poses),
        "the truth over": (times, _moved(poses, 20 * poses[:, :3, 3])),
        "around their mean": (
            times,
            _moved(poses, np.random.default_rng(1).uniform(-1, 1, (COUNT, 3))),
        ),
    }
    turned = poses @ se3_exp([0, 0, 0, 0, 0, 1.0])  # positions stay
    others["orientations are 57.3 deg off"] = (times, turned)
    for complaint, other in others.items():
        write_trajectory(tmp_path / "other.txt", *other)
        assert main(["evaluate", estimate, str(tmp_path / "other.txt")]) == 0
        said = capsys.readouterr().err
        assert "other.txt may be of another recording" in said
        assert complaint in said


def test_a_scale_that_fits_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    estimate, truth = write_pair(tmp_path, scale=5.0)
    assert main(["evaluate", estimate, truth]) == 0
    assert "times 0.2 it fits, as with a wrong depth scale" in capsys.readouterr().err
    assert main(["evaluate", estimate, truth, "--align", "sim3"]) == 0
    assert capsys.readouterr().err == ""


def test_a_turn_that_the_positions_leave_open_is_not_complained_about(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three millimetres beside a straight path, with errors as large, the turn about it is free."""
    rng = np.random.default_rng(0)
    truth = np.tile(np.eye(4), (40, 1, 1))
    truth[:, 0, 3] = np.linspace(0.0, 0.4, 40)
    truth[:, :3, 3] += rng.normal(0.0, 0.003, (40, 3))
    turned = truth @ se3_exp([0, 0, 0, 1.0, 0, 0])
    assert "57.3 deg" in complaints(turned, truth)[0]  # here the positions are exact
    turned[:, :3, 3] += rng.normal(0.0, 0.003, (40, 3))
    assert complaints(turned, truth) == []
    times = np.arange(40.0)
    pair = [str(tmp_path / name) for name in ("estimate.txt", "truth.txt")]
    write_trajectory(pair[0], times, turned)
    write_trajectory(pair[1], times, truth)
    assert main(["evaluate", *pair]) == 0
    assert "the path is too straight or short" in one_line(capsys.readouterr().err)
    assert main(["evaluate", *pair, "--align", "origin"]) == 0
    assert capsys.readouterr().err == ""


def _moved(poses: np.ndarray, positions: np.ndarray) -> np.ndarray:
    moved = poses.copy()
    moved[:, :3, 3] = positions
    return moved


def test_gaps_are_lost_segments(tmp_path: Path) -> None:
    keep = np.ones(COUNT, dtype=bool)
    keep[40:60] = False  # 59 is the last one lost: 21 intervals of 0.05 s without a pose
    keep[80] = False  # 2 intervals: not longer than three times the median
    pair = write_pair(tmp_path, noise=0.0, keep=keep)
    result = evaluate_files(*map(Path, pair))
    assert (result["gaps"], result["tracked_pieces"]) == (1, 2)
    assert result["lost_s"] == pytest.approx(21 * 0.05)
    assert result["robustness"] == pytest.approx(0, abs=1e-6)
    strict = evaluate_files(*map(Path, pair), TrajectoryOptions(gap_s=0.08))
    assert (strict["gaps"], strict["tracked_pieces"]) == (2, 3)
    # The second piece elsewhere: the error is by how much.
    lines = Path(pair[0]).read_text().splitlines()
    moved = []
    for line in lines[41:]:
        numbers = line.split()
        numbers[1] = f"{float(numbers[1]) + 0.25:.9f}"
        moved.append(" ".join(numbers))
    Path(pair[0]).write_text("\n".join([*lines[:41], *moved]))
    shifted = evaluate(pair, tmp_path / "out")
    assert shifted["robustness_translation_m"] == pytest.approx(0.25, abs=1e-5)
    assert shifted["robustness_rotation_rad"] == pytest.approx(0, abs=1e-5)


def test_frames_that_a_run_lost_are_gaps(tmp_path: Path) -> None:
    pair = write_pair(tmp_path, noise=0.0)
    times, poses = read_trajectory(pair[0])
    poses[50:53, :3, 3] += 5.0  # where it was while it was lost does not count
    write_trajectory(pair[0], times, poses)
    frames = tmp_path / "frames.csv"
    rows = [f"{t:.6f},{int(k not in (50, 51, 52, 80))},1.5" for k, t in enumerate(times)]
    frames.write_text("\n".join(["timestamp,tracking_ok,ext_ms", *rows]))
    everything = evaluate_files(*map(Path, pair))
    assert everything["ate_max_m"] > 1
    assert everything["poses"] == COUNT
    assert everything["ate_tracked_m"] < 1e-6
    result = evaluate([*pair, "--frames", str(frames)], tmp_path / "out")
    assert result["poses"] == COUNT - 4
    assert result["tracked_share"] == everything["tracked_share"] == pytest.approx(1 - 4 / COUNT)
    assert result["ate_max_m"] < 1e-6
    for robustness in (result, everything):  # beside the estimate it needs no option
        assert (robustness["gaps"], robustness["tracked_pieces"]) == (2, 3)
        assert robustness["lost_s"] == pytest.approx(4 * 0.05 + 2 * 0.05)
        assert robustness["covered_share"] == pytest.approx(1 - 6 / (COUNT - 1), abs=1e-3)
        assert robustness["robustness"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("how", ["beside", "asked", "poses that end"])
def test_an_estimate_lost_for_good_has_no_robustness(
    how: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair, tracked = write_pair(tmp_path, noise=0.0), 12
    times, poses = read_trajectory(pair[0])
    if how == "poses that end":
        write_trajectory(pair[0], times[:tracked], poses[:tracked])
    else:
        poses[tracked:] = poses[tracked - 1]
        write_trajectory(pair[0], times, poses)
        rows = [f"{t:.6f},{int(k < tracked)}" for k, t in enumerate(times)]
        (tmp_path / "frames.csv").write_text("\n".join(["timestamp,tracking_ok", *rows]))
    option = ["--frames", str(tmp_path / "frames.csv")] if how == "asked" else []
    result = evaluate([*pair, *option], tmp_path / "out")
    assert (result["robustness"], result["tracked_pieces"]) == (None, 1)
    assert result["covered_share"] == pytest.approx((tracked - 1) / (COUNT - 1), abs=1e-3)
    if how != "poses that end":
        assert result["gaps"] == 1
        assert result["lost_time_share"] == pytest.approx(1 - (tracked - 1) / (COUNT - 1))
    reason = {"poses that end": "the truth goes on for 5.397 s after the last pose"}
    said = reason.get(how, "no piece follows the last loss")
    assert result["robustness_reason"].startswith(said)
    shown = capsys.readouterr().out
    assert f"robustness error not available: {said}" in shown
    assert "(9 % of the truth's time)" in shown
    assert said in (tmp_path / "out" / "table.md").read_text()


def test_an_estimate_lost_from_the_second_frame_is_not_whole(tmp_path: Path) -> None:
    pair = write_pair(tmp_path, noise=0.0)
    times, _ = read_trajectory(pair[0])
    rows = [f"{t:.6f},{int(k == 0)}" for k, t in enumerate(times)]
    (tmp_path / "frames.csv").write_text("\n".join(["timestamp,tracking_ok", *rows]))
    result = evaluate_files(*map(Path, pair))
    assert (result["robustness"], result["tracked_pieces"]) == (None, 0)
    assert result["tracked_share"] == pytest.approx(1 / COUNT)
    assert result["covered_share"] == 0.0


def test_frames_beside_the_estimate_say_what_was_tracked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair, frames = write_pair(tmp_path), tmp_path / "frames.csv"
    times, poses = read_trajectory(Path(pair[0]))
    _, truth = truth_path()
    assert evaluate_files(*map(Path, pair))["tracked_share"] is None
    ok = np.arange(COUNT) % 4 > 0
    rows = [f"{t:.6f},{int(was)}" for t, was in zip(times, ok, strict=True)]
    frames.write_text("\n".join(["timestamp,tracking_ok", *rows]))
    capsys.readouterr()
    result = evaluate(pair, tmp_path / "out")
    assert (result["poses"], result["tracked_share"], result["gaps"]) == (COUNT, 0.75, COUNT // 4)
    assert result["ate_tracked_m"] == pytest.approx(metrics.ate_rmse(poses[ok], truth[ok]))
    assert result["ate_m"] == pytest.approx(metrics.ate_rmse(poses, truth))
    said = capsys.readouterr().out
    assert f"tracked: 75.0% of the poses, ATE of these {result['ate_tracked_m']:.6f} m" in said
    assert "Tracked: 75.0% of the poses" in (tmp_path / "out" / "table.md").read_text()
    scaled = evaluate_files(*map(Path, pair), TrajectoryOptions("sim3"))
    assert (scaled["tracked_share"], scaled["ate_tracked_m"]) == (0.75, None)
    # One that is of other frames, or no table of ours, is left aside with a word.
    for lines, word in (
        (rows[:-1], "belongs to other frames"),
        (["a,b"], "line 1: expected columns"),
    ):
        head = ["timestamp,tracking_ok"] if len(lines) > 1 else []
        frames.write_text("\n".join([*head, *lines]))
        assert main(["evaluate", *pair]) == 0
        shown = capsys.readouterr()
        assert "left aside" in shown.err
        assert word in shown.err
        assert "tracked" not in shown.out


def test_bad_frames_are_one_line_and_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair, frames = write_pair(tmp_path), tmp_path / "frames.csv"
    head = "timestamp,tracking_ok"
    lost = [f"{t + 0.003:.6f},0" for t in truth_path()[0]]
    for lines, message in (
        (None, "cannot read frames"),
        (["time,ok"], "line 1: expected columns timestamp, tracking_ok"),
        ([head, "0.1,1", "0.2,yes"], "line 3: expected a timestamp"),
        ([head, "0.1"], "line 2: expected a timestamp"),
        ([head, *lost], "leaves 0 tracked poses"),
    ):
        if lines is not None:
            frames.write_text("\n".join(lines))
        assert main(["evaluate", *pair, "--frames", str(frames)]) == 2
        assert message in one_line(capsys.readouterr().err)


def test_a_straight_path_has_no_orientation_error(tmp_path: Path) -> None:
    line = np.repeat(np.eye(4)[None], 30, axis=0)
    line[:, 0, 3] = 0.1 * np.arange(30)
    for name in ("estimate.txt", "truth.txt"):
        write_trajectory(tmp_path / name, 0.1 * np.arange(30), line)
    pair = [str(tmp_path / "estimate.txt"), str(tmp_path / "truth.txt")]
    result = evaluate(pair, tmp_path / "out")
    assert result["ate_rad"] is None
    assert result["ate_max_m"] == pytest.approx(0, abs=1e-9)
    unaligned = evaluate_files(*map(Path, pair), TrajectoryOptions(align="none"))
    assert unaligned["ate_unaligned_max_rad"] == 0


def test_two_poses_and_a_camera_that_stands_still(tmp_path: Path) -> None:
    still = np.repeat(np.eye(4)[None], 2, axis=0)
    write_trajectory(tmp_path / "still.txt", [0.0, 1.0], still)
    result = evaluate([str(tmp_path / "still.txt")] * 2, tmp_path / "out")
    assert (result["poses"], result["drift_by_length"], result["ate_rad"]) == (2, [], None)
    assert result["robustness"] is None
    assert result["initialisation_s"] is None


def test_trajectories_of_other_times_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate, truth = write_pair(tmp_path)
    times, poses = read_trajectory(Path(truth))
    write_trajectory(truth, times + 100, poses)
    assert main(["evaluate", estimate, truth]) == 2
    assert "0 timestamps in common" in one_line(capsys.readouterr().err)


T_TRUE_MAP = se3_exp([0.02, -0.015, 0.01, 0.01, -0.01, 0.015])


@pytest.fixture
def maps(tmp_path: Path) -> list[str]:
    """A cloud of a box, moved and with ten far points, and the box as a mesh."""
    box = trimesh.creation.box(extents=[2.0, 1.5, 1.0])
    box.export(tmp_path / "box.ply")
    points, _ = trimesh.sample.sample_surface(box, 20_000, seed=1)
    points = transform_points(invert(T_TRUE_MAP), np.asarray(points))
    far = 3.0 + np.random.default_rng(0).uniform(0, 20, (10, 3))
    write_ply(tmp_path / "map.ply", np.concatenate([points, far]), {})
    return ["--map", str(tmp_path / "map.ply"), "--true-map", str(tmp_path / "box.ply")]


def test_maps_by_their_measures(maps: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ["--samples", "30000", "--voxel-m", "0", "--thresholds-m", "0.01", "0.025"]
    result = evaluate([*maps, *options], out)
    assert sorted(path.name for path in out.iterdir()) == [
        *("evaluation.json", "map.png", "map_shares.png", "table.md")
    ]
    assert (out / "map.png").stat().st_size > 10_000
    assert (result["map_kind"], result["true_map_kind"]) == ("cloud", "mesh")
    assert (result["map_points"], result["true_points"]) == (20_010, 30_000)
    points = trimesh.load(tmp_path / "map.ply").vertices
    box = trimesh.load(tmp_path / "box.ply")
    surface, _ = trimesh.sample.sample_surface(box, 30_000, seed=0)
    expected = {
        "precision_1cm": metrics.precision(points, surface, 0.01),
        "recall_2.5cm": metrics.recall(points, surface, 0.025),
        "f_score_2.5cm": metrics.f_score(points, surface, 0.025),
        "rer_m": metrics.rer(points, surface),
        "rcm": metrics.rcm(points, surface),
        "accuracy_cm": metrics.completion(points, surface).accuracy_cm,
        "completion_cm": metrics.completion(points, surface).completion_cm,
        "c2c_rms_m": metrics.cloud_distance(points, surface).rms,
        "hausdorff_m": metrics.hausdorff_distance(points, surface),
        "noise_ratio": metrics.noise_ratio(points, surface),
        "noise_beyond_m": 3 * np.hypot(0.01, metrics.point_spacing(surface)),
        "spacing_m": metrics.point_spacing(points),
    }
    for name, value in expected.items():
        assert result[name] == pytest.approx(value, abs=1e-12), name
    assert result["hausdorff_m"] > 3
    np.testing.assert_array_equal(result["T_true_map"], np.eye(4))


@pytest.mark.parametrize("kind", ["mesh", "cloud"])
def test_a_plane_on_the_border_of_voxels_counts_once(kind: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    found = []
    for jitter in (0.0, 1e-7):
        plates = [trimesh.creation.box(extents=[2.0, 2.0, 0.0]) for _ in range(2)]
        plates[1].apply_translation([0, 0, 1.0025])
        corners = np.concatenate([plate.vertices[[0, 2, 6, 4]] for plate in plates])
        faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
        true = trimesh.Trimesh(corners, faces, process=False)
        if kind == "cloud":
            points, _ = trimesh.sample.sample_surface(true, 40_000, seed=0)
            points = np.asarray(points) + rng.uniform(-jitter, jitter, (40_000, 3))
            write_ply(tmp_path / "true.ply", points, {})
        else:
            true.vertices = true.vertices + rng.uniform(-jitter, jitter, true.vertices.shape)
            true.export(tmp_path / "true.obj", digits=12)
        lower = np.column_stack([rng.uniform(-1, 1, (20_000, 2)), np.zeros(20_000)])
        lower[:, 2] += rng.uniform(-jitter, jitter, len(lower))
        write_ply(tmp_path / "map.ply", lower, {})
        truth = tmp_path / ("true.ply" if kind == "cloud" else "true.obj")
        options = MapOptions(voxel_m=0.05, samples=20_000)
        found.append(evaluate_maps(tmp_path / "map.ply", truth, options)[0])
    for one in found:
        assert one["completion_ratio"] == pytest.approx(0.5, abs=0.02)
        assert one["completion_cm"] == pytest.approx(51.3, abs=2)
    assert found[0]["accuracy_cm"] == pytest.approx(found[1]["accuracy_cm"], rel=0.01)


@pytest.mark.parametrize("method", ["icp", "plane-icp", "gicp"])
def test_registered_maps_lie_where_they_belong(
    maps: list[str], tmp_path: Path, method: str
) -> None:
    options = ["--register", method, "--remove-outliers", "--samples", "30000"]
    result = evaluate([*maps, *options], tmp_path / "out")
    np.testing.assert_allclose(result["T_true_map"], T_TRUE_MAP, atol=5e-3)
    assert result["registration_share"] > 0.99
    assert result["hausdorff_directed_m"] < 0.05
    assert result["precision_2cm"] > 0.9  # points of either surface are 17 mm apart
    assert result["outlier_share"] == pytest.approx(10 / 20_010)
    far = 10 / (result["compared_points"] + 10)  # one a voxel, with those that were removed
    assert result["noise_ratio"] == pytest.approx(far)


def test_a_sequence_stands_for_the_surface_that_it_saw(tmp_path: Path) -> None:
    """A wall 2 m ahead, seen by two frames; the recorded depth is 3 cm off, the true one is not."""
    folder = tmp_path / "wall"
    intrinsics = xtion("80x60")
    for name, metres in (("depth", 2.03), ("depth_true", 2.0)):
        (folder / name).mkdir(parents=True)
        for k in range(2):
            values = np.full(intrinsics.shape, round(5000 * metres), dtype=np.uint16)
            Image.fromarray(values).save(folder / name / f"{k}.png")
    (folder / "depth.txt").write_text("0.0 depth/0.png\n1.0 depth/1.png\n")
    i = intrinsics
    (folder / "intrinsics.txt").write_text(f"{i.fx} {i.fy} {i.cx} {i.cy} {i.width} {i.height} 5000")
    poses = np.stack([np.eye(4), make_pose(np.eye(3), [0.1, 0, 0])])
    write_trajectory(folder / "groundtruth.txt", [0.0, 1.0], poses)
    wall = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 60)] * 2, [2.0]), -1).reshape(-1, 3)
    write_ply(tmp_path / "wall.ply", wall, {})
    result, _ = evaluate_maps(tmp_path / "wall.ply", folder)
    assert result["true_map_kind"] == "true depth"
    assert result["rer_m"] < 0.02
    assert result["precision_2cm"] == 1
    shutil.rmtree(folder / "depth_true")
    result, _ = evaluate_maps(tmp_path / "wall.ply", folder)
    assert (result["true_map_kind"], result["precision_2cm"]) == ("recorded depth", 0)
    (folder / "groundtruth.txt").unlink()
    with pytest.raises(InputError, match="no true trajectory"):
        evaluate_maps(tmp_path / "wall.ply", folder)


def test_trajectory_and_map_together(maps: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = evaluate([*write_pair(tmp_path), *maps, "--samples", "5000"], out)
    assert {"ate_m", "accuracy_cm", "provenance"} <= set(result)
    assert {"map.png", "trajectory.png"} <= {path.name for path in out.iterdir()}
    table = (out / "table.md").read_text()
    assert "ATE [mm]" in table
    assert "F-score at 2 cm [%]" in table


def test_a_bad_map_leaves_no_half_of_a_result(maps: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    bad = [*write_pair(tmp_path), "--map", "none.ply", *maps[2:], "--out", str(out)]
    assert main(["evaluate", *bad]) == 2
    assert not out.exists()


def test_a_truth_that_stands_still_has_no_scale(tmp_path: Path) -> None:
    pair = write_pair(tmp_path)
    t, poses = truth_path()
    poses[:, :3, 3] = 1.0
    write_trajectory(tmp_path / "truth.txt", t, poses)
    result = evaluate([*pair, "--align", "sim3"], tmp_path / "out")
    assert "stands still" in result["robustness_reason"]
    assert result["initialisation_s"] is None


def test_bad_maps_are_one_line_and_code_2(
    maps: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(arguments: list[str]) -> str:
        assert main(["evaluate", *arguments]) == 2
        return one_line(capsys.readouterr().err)

    junk = tmp_path / "junk.ply"
    junk.write_text("ply?")
    empty = tmp_path / "empty.ply"
    write_ply(empty, np.zeros((0, 3)), {})
    endless = tmp_path / "endless.ply"
    write_ply(endless, np.array([[0.0, np.inf, 0.0]]), {})
    few = tmp_path / "few.ply"
    write_ply(few, np.zeros((3, 3)), {})
    assert "Missing files" in refused([])
    assert "maps are given as" in refused(maps[:2])
    assert "valid choices: none, icp, plane-icp, gicp" in refused([*maps, "--register", "sift"])
    assert "thresholds_m = 0.0 is outside" in refused([*maps, "--thresholds-m", "0"])
    assert "voxel_m = -1.0 is outside" in refused([*maps, "--voxel-m", "-1"])
    assert "'none.ply' does not exist" in refused(["--map", "none.ply", *maps[2:]])
    assert "cannot be read" in refused(["--map", str(junk), *maps[2:]])
    assert "holds no points" in refused([*maps[:2], "--true-map", str(empty)])
    assert "not finite" in refused(["--map", str(endless), *maps[2:]])
    assert "20 neighbours need as many points" in refused(["--map", str(few), *maps[2:]])


@pytest.mark.parametrize("name", ["groundtruth.txt", "fr1_gt.txt", "Reference.tum"])
def test_files_in_the_wrong_order_get_a_warning(tmp_path: Path, capsys: Any, name: str) -> None:
    estimate, truth = map(Path, write_pair(tmp_path))
    truth = truth.rename(tmp_path / name)
    assert main(["evaluate", str(truth), str(estimate)]) == 0
    assert f"{name} is named like a truth, {estimate} is not" in capsys.readouterr().err
    assert main(["evaluate", str(estimate), str(truth)]) == 0
    assert "named like" not in capsys.readouterr().err
    other = Path(shutil.copy(truth, tmp_path / "reference.txt"))  # two truths are compared silently
    assert main(["evaluate", str(other), str(truth)]) == 0
    assert "named like" not in capsys.readouterr().err
