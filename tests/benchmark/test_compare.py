"""``ms-slam compare``: bad input, medians, tables, a run from end to end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env import sequences
from ms_slam_env.benchmark import compare
from ms_slam_env.benchmark.compare import PEERS, Compare, CompareSpec
from ms_slam_env.benchmark.compare_tables import (
    METRICS,
    comparison_tables,
    distinct_names,
)
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, se3_exp
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.report.statistics import median_interval, share_interval
from ms_slam_env.sequences import read_trajectory, write_trajectory


def row(sequence: str, backend: str, cpu_ms: float | None, error: str | None = None, **more: Any):
    spec = {"sequence": sequence, "backend": backend, "image_size": "160x120"}
    result = None if error else {**dict.fromkeys(METRICS[:-1], 1.0), "cpu_ms_median": cpu_ms}
    if result is not None:
        result |= {"ene_frame_j": None, **more}
    return {"key": f"{sequence}{backend}{cpu_ms}", "spec": spec, "result": result, "error": error}


ROWS = [
    row("a:1", "one", 1.0),
    row("a:1", "two", 4.0),
    row("b:1", "one", 3.0),
    row("b:1", "one", 5.0),
    row("b:1", "two", 6.0),
    row("c:1", "one", 100.0),
    row("c:1", "two", None, "RuntimeError: no"),
]


def test_the_peers_are_rows_of_their_own() -> None:
    assert set(PEERS) <= {spec.backend for spec in Compare().specs()}


def test_a_run_from_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = "table:1000:none+exposure-ramp"
    options = ["--sequences", sequence, "--image-sizes", "80x60", "--frames", "12"]
    command = ["compare", *options, "--backends", "odometry,keyframe_m=0.05"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    assert f"| {sequence} | odometry,keyframe_m=0.05 |" in capsys.readouterr().out
    content = json.loads((tmp_path / "results.json").read_text())
    (made,) = content["rows"]
    result = made["result"]
    assert (content["kind"], result["frames"], result["lost_share"]) == ("compare", 12, 0)
    assert result["ate_unaligned_m"] < 0.05
    assert result["map_error_median_m"] < 0.01
    assert 0 < result["cpu_ms_median"] <= result["cpu_ms_p95"]
    assert result["mem_peak_mb"] > 0
    assert (tmp_path / "compare.png").stat().st_size > 1000
    monkeypatch.setattr(compare, "limit_threads", lambda _: None)
    # The same in this process, to the last bit.
    again = Compare.run(CompareSpec(**made["spec"]))
    assert {key: again[key] for key in ("ate_m", "rpe_m", "map_points")} == {
        key: result[key] for key in ("ate_m", "rpe_m", "map_points")
    }


def test_the_trajectory_of_a_backend_has_the_numbers_of_the_backend(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ["--scene", "table", "--path.frames", "20", "--image-size", "80x60"]
    dark = ["--perturbations", "black-frames,start=12,length=3"]
    folders = [str(tmp_path / name) for name in ("lit", "dark")]
    for folder, options in zip(folders, ([], dark), strict=True):
        assert main(["generate", *small, *options, "--out", folder]) == 0
        out = tmp_path / "runs" / Path(folder).name
        assert main(["run", folder, "--backend", "odometry", "--out", str(out)]) == 0
    files = f"{tmp_path}/runs/{{sequence}}/trajectory.txt"
    command = ["compare", "--sequences", *folders, "--image-sizes", "80x60", "--backends"]
    few = f"few={tmp_path}/{{sequence}}.txt"
    command += ["odometry", "--trajectories", f"outside={files}", few]
    # A system that gives poses of tracked frames only, in a world of its own, and fails on one.
    times, poses = read_trajectory(tmp_path / "runs" / "lit" / "trajectory.txt")
    moved = se3_exp([1, 2, 3, 0.3, 0.2, 0.1]) @ poses
    write_trajectory(tmp_path / "lit.txt", times[3:15], moved[3:15])
    capsys.readouterr()
    assert main([*command, "--out", str(tmp_path / "out")]) == 1
    assert "dark.txt" in capsys.readouterr().err
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["rows"]
    found = {(row["spec"]["backend"], row["spec"]["sequence"]): row["result"] for row in rows}
    for folder in folders:
        own, outside = found["odometry", folder], found["outside", folder]
        for key in ("frames", "path_m", "tracked_share", "lost_share"):
            assert outside[key] == own[key], key
        for key in ("ate_m", "ate_tracked_m", "ate_max_m", "ate_unaligned_m", "rpe_m", "rpe_rad"):
            assert outside[key] == pytest.approx(own[key], abs=1e-6), key
        assert "cpu_ms_median" not in outside
    assert found["odometry", folders[1]]["lost_share"] > 0
    part = found["few", folders[0]]
    truth = read_trajectory(Path(folders[0]) / "groundtruth.txt")[1]
    assert part["tracked_share"] == 12 / 20
    assert part["ate_tracked_m"] == pytest.approx(ate_rmse(poses[3:15], truth[3:15]), abs=1e-6)
    held = np.concatenate([[poses[3]] * 3, poses[3:15], [poses[14]] * 5])
    assert part["ate_m"] == pytest.approx(ate_rmse(held, truth), abs=1e-6)
    first = ate_rmse(truth[3] @ invert(held[3]) @ held, truth, align="none")
    assert part["ate_unaligned_m"] == pytest.approx(first, abs=1e-6)


@given(st.lists(st.lists(st.sampled_from("ab"), min_size=2, max_size=4).map("/".join), unique=True))
def test_folders_have_names_of_their_own(folders: list[str]) -> None:
    names = distinct_names([*folders, "table:1"])
    ends = [folder for folder in folders if not any(o.endswith("/" + folder) for o in folders)]
    assert len({names[folder] for folder in ends}) == len(ends)
    assert all(folder.endswith(names[folder]) for folder in folders)
    assert names["table:1"] == "table:1"


def test_folders_of_one_name_are_two_sequences() -> None:
    rows = []
    for row in ROWS:
        name = {"a:1": "x/s", "b:1": "y/s", "c:1": "c:1"}[row["spec"]["sequence"]]
        rows.append({**row, "spec": {**row["spec"], "sequence": name}})
    table, _ = Compare().tables(rows)
    assert {line["sequence"] for line in table.rows} == {"x/s", "y/s", "c:1", "median"}
    counts = {line["backend"]: line.get("sequences_count") for line in table.rows}
    assert counts == {"one": 3, "two": 2}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"backends": ("surfel,loop_closur=deformation",)}, "loop_closur"),
        ({"sequences": ("x/s", "y/s"), "trajectories": ("orb=o/{sequence}.txt",)}, "same file"),
    ],
)
def test_what_no_run_could_use_is_refused(more, said, monkeypatch) -> None:
    monkeypatch.setattr(sequences, "check_sequence", lambda text: None)
    with pytest.raises(InputError, match=said):
        Compare(**more)


def test_a_system_without_any_trajectory_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--sequences", "table:1", "--trajectories", f"orb={tmp_path}/{{sequence}}.txt"]
    assert main(["compare", *options, "--out", str(tmp_path / "out")]) == 2
    assert f"no trajectory of orb: {tmp_path}/table:1.txt" in capsys.readouterr().err


def test_a_median_is_over_what_its_own_system_finished() -> None:
    table, _ = Compare().tables(ROWS)
    lines = [line for line in table.rows if line["sequence"] != "median"]
    assert [line["cpu_ms_median"] for line in lines if line["backend"] == "one"] == [1, 4, 100]
    medians = {line["backend"]: line for line in table.rows if line["sequence"] == "median"}
    for name, values in (("one", [1, 4, 100]), ("two", [4, 6])):
        assert medians[name]["cpu_ms_median"] == median_interval(values)
        assert medians[name]["sequences_count"] == len(values)
    failed = next(line for line in lines if "error" in line)
    assert (failed["sequence"], failed["error"]) == ("c:1", "RuntimeError: no")
    assert "of 3; two over 2, not c:1: RuntimeError: no" in table.note
    (chart,) = Compare().charts(ROWS)
    assert [series.name for series in chart.panels[0].series] == ["one", "two"]
    assert "Not shown: two (failed: 1 of 3)." in chart.caption


def test_a_system_that_always_fails_takes_nothing_from_the_others() -> None:
    broken = [row(f"{k}:1", "broken", None, "InputError: exit code 3") for k in "abc"]
    (alone, own), (table, differences) = (Compare().tables(rows) for rows in (ROWS, ROWS + broken))
    lines = [line for line in table.rows if line["backend"] != "broken"]
    assert lines == list(alone.rows)
    assert differences == own
    (last,) = (
        line for line in table.rows if line["backend"] == "broken" and line["sequence"] == "median"
    )
    assert last["sequences_count"] == 0
    assert "broken over 0, not a:1: InputError: exit code 3" in table.note
    (chart,) = Compare().charts(ROWS + broken)
    assert "broken (failed: 3 of 3)" in chart.caption


def test_the_figure_has_every_system_whose_time_is_known_and_names_the_others() -> None:
    command, trajectory = row("a:1", "mine", None), row("a:1", "orb", None, cpu_ms_mean=None)
    (chart,) = Compare().charts([*ROWS[:2], command, trajectory])
    assert [series.name for series in chart.panels[0].series] == ["one", "two", "mine"]
    assert "Not shown: orb (time not known: 1 of 1)." in chart.caption


def test_a_median_over_fewer_sequences_says_so() -> None:
    rows = [row(f"{k}:1", name, 1.0) for k in "abc" for name in ("one", "two")]
    rows[1]["result"]["ate_tracked_m"] = None
    table, differences = Compare().tables(rows)
    assert "two's ATE, tracked frames over 2" in table.note
    (line,) = differences.rows
    assert line["sequences_count"] == 3


def test_differences_are_of_the_same_sequences() -> None:
    ate = {"one": [1.0, 2.0, 4.0, 9.0], "two": [0.5, 2.5, 3.0, 7.0]}
    rows = [
        row(f"{k}:1", name, 1.0, ate_m=value)
        for name, values in ate.items()
        for k, value in enumerate(values)
    ]
    rows.append(row("4:1", "one", 1.0, ate_m=-100.0))
    rows.append(row("4:1", "two", None, "RuntimeError: no"))
    for reference, other, sign in (("", "two", 1), ("two", "one", -1)):
        _, differences = comparison_tables(rows, reference or "one")
        assert differences.title == f"160x120: differences from {reference or 'one'}"
        (line,) = differences.rows
        more = [sign * (b - a) for a, b in zip(*ate.values(), strict=True)]
        assert (line["backend"], line["sequences_count"]) == (other, 4)
        assert line["ate_m_more"] == median_interval(more)
        wins = sum(value < 0 for value in more)
        assert line["better_share"] == share_interval([True] * wins + [False] * (4 - wins))
        assert "ATE, difference [mm]" in differences.as_markdown()


def test_energy_has_a_column_where_a_machine_counts_it() -> None:
    counted = [row("a:1", "one", 1.0, ene_frame_j=0.25), row("a:1", "two", 1.0)]
    names = [[c.name for c in Compare().tables(rows)[0].columns] for rows in (counted, ROWS)]
    assert ["ene_frame_j" in columns for columns in names] == [True, False]


def test_the_command_refuses_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "--backends", "lidar"]) == 2
    assert "unknown SLAM backend 'lidar'; valid choices: surfel" in capsys.readouterr().err
