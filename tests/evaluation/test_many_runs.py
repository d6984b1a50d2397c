"""Many runs against one truth, tables as LaTeX and CSV, a Rerun recording."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.units import Unit
from evo.tools import file_interface

from ms_slam_env.cli import main
from ms_slam_env.geometry import make_pose, se3_exp, so3_exp
from ms_slam_env.report.statistics import Interval, median_interval
from ms_slam_env.report.table_files import as_csv, as_latex
from ms_slam_env.report.tables import make_table
from ms_slam_env.sequences import write_trajectory

COUNT = 80


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    """A truth, three runs of one system and one of a worse one, each in a world of its own."""
    folder = tmp_path_factory.mktemp("runs")
    t = 0.05 * np.arange(COUNT)
    truth = np.stack(
        [make_pose(so3_exp([0.1 * x, 0.2 * x, 0]), [np.sin(x), np.cos(x), x]) for x in t]
    )
    write_trajectory(folder / "truth.txt", t, truth)
    paths = {"truth": folder / "truth.txt"}
    for seed, (name, noise) in enumerate(
        [("good1", 0.005), ("good2", 0.006), ("good3", 0.008), ("bad", 0.05)]
    ):
        rng = np.random.default_rng(seed)
        world = se3_exp(rng.normal(size=6))
        poses = np.stack([world @ T @ se3_exp(rng.normal(0, noise, 6)) for T in truth])
        paths[name] = folder / f"{name}.txt"
        write_trajectory(paths[name], t, poses)
    return paths


def options(files: dict[str, Path]) -> list[str]:
    runs = [f"good={files[f'good{k}']}" for k in (1, 2, 3)]
    return ["evaluate", "--runs", *runs, str(files["bad"]), "--truth", str(files["truth"])]


def evo_errors(estimate: Path, truth: Path, delta: int) -> np.ndarray:
    pair = [file_interface.read_tum_trajectory_file(str(p)) for p in (truth, estimate)]
    reference, own = sync.associate_trajectories(*pair)
    rpe = evo_metrics.RPE(
        evo_metrics.PoseRelation.translation_part, delta, Unit.frames, all_pairs=True
    )
    rpe.process_data((reference, own))
    return rpe.error


def test_deltas_stand_in_the_place_of_the_delta(files, tmp_path) -> None:
    more = ["--delta-unit", "m", "--delta", "1000", "--deltas", "0.3", "--out", str(tmp_path / "o")]
    assert main([*options(files), *more]) == 0
    first = json.loads((tmp_path / "o" / "evaluation.json").read_text())["runs"][0]
    assert main([*options(files), *more[:2], "--delta", "0.3", "--out", str(tmp_path / "p")]) == 0
    second = json.loads((tmp_path / "p" / "evaluation.json").read_text())["runs"][0]
    assert first["rpe_m"] == second["rpe_m"]


def test_runs_of_a_system_stand_together_with_their_interval(files, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    more = ["--deltas", "1", "5", "--tables", "csv", "latex", "--out", str(out)]
    assert main([*options(files), *more]) == 0
    assert "good" in capsys.readouterr().out
    result = json.loads((out / "evaluation.json").read_text())
    runs = {Path(run["estimate_file"]).stem: run for run in result["runs"]}
    assert list(runs) == ["good1", "good2", "good3", "bad"]
    systems = {row["system"]: row for row in csv.DictReader((out / "table_1.csv").open())}
    expected = median_interval([runs[f"good{k}"]["ate_m"] for k in (1, 2, 3)])
    assert float(systems["good"]["ate_m"]) == pytest.approx(expected.value)
    assert float(systems["good"]["ate_m_low"]) == pytest.approx(expected.low)
    assert systems["good"]["runs_count"] == "3"
    assert float(systems["bad"]["ate_m"]) > 3 * float(systems["good"]["ate_m_high"])
    # The boxes are quantiles of the errors that evo finds, the runs of a system pooled.
    boxes = list(csv.DictReader((out / "table_2.csv").open()))
    assert [(row["system"], row["delta_text"]) for row in boxes] == [
        *(("good", f"{delta} frames") for delta in (1, 5)),
        *(("bad", f"{delta} frames") for delta in (1, 5)),
    ]
    for row in boxes:
        own = ["good1", "good2", "good3"] if row["system"] == "good" else ["bad"]
        delta = int(row["delta_text"].split()[0])
        errors = np.concatenate([evo_errors(files[o], files["truth"], delta) for o in own])
        assert int(row["pose_pairs"]) == len(errors)
        found = [float(row[name]) for name in ("quartile_25", "median", "quartile_75")]
        np.testing.assert_allclose(found, np.percentile(errors, [25, 50, 75]), atol=1e-6)
    assert (out / "errors.png").stat().st_size > 10_000
    assert sorted(p.suffix for p in out.glob("table_*")) == [".csv"] * 3 + [".tex"] * 3


def test_a_recording_holds_every_pose_of_every_run(files, tmp_path) -> None:
    pytest.importorskip("rerun")
    out = tmp_path / "out"
    assert main([*options(files), "--rerun", "--out", str(out)]) == 0
    tool = Path(sys.executable).with_name("rerun")
    said = subprocess.run(
        [tool, "rrd", "print", out / "evaluation.rrd"], capture_output=True, text=True, check=True
    ).stdout
    for name in ("good_1", "good_2", "good_3", "bad"):
        assert f"/error/{name}" in said
        assert f"/world/{name}/path" in said
    assert "/world/truth" in said
    assert said.count(f"with {COUNT} rows") >= 8


def test_latex_escapes_and_csv_keeps_full_numbers() -> None:
    rows = [
        {"planner": "a_b & 5 %", "ate_m": Interval(0.0123456789, 0.01, 0.02), "lost_s": None},
        {"planner": "c", "ate_m": 0.5, "lost_s": float("inf")},
    ]
    table = make_table(("planner", "ate_m", "lost_s"), rows, "Title", "Of 10 %")
    latex = as_latex(table)
    assert r"a\_b \& 5 \% & 12.3 [10.0, 20.0] & - \\" in latex
    assert r"\caption{Title. Of 10 \%.}" in latex
    assert latex.count("{") == latex.count("}")
    assert r"ATE [mm]" in latex
    lines = list(csv.reader(io.StringIO(as_csv(table))))
    assert lines[0] == ["planner", "ate_m", "ate_m_low", "ate_m_high", "lost_s"]
    assert lines[1] == ["a_b & 5 %", "0.0123456789", "0.01", "0.02", ""]
    assert lines[2] == ["c", "0.5", "", "", "inf"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda o: o[:-2], "runs are given as --runs FILE ... --truth GROUNDTRUTH"),
        (lambda o: [*o, "--tables", "word"], "--tables and --rerun write files"),
        (lambda o: [*o, "--tables", "word", "--out", "x"], "valid choices: latex, csv"),
        (lambda o: [*o, "--deltas", "500"], "good1.txt: delta = 500"),
        (lambda o: ["evaluate", o[-1], o[-1], *o[1:]], "--runs cannot be combined"),
        (lambda o: [o[0], o[1], o[2], *o[2:]], "a run is given twice"),
        (lambda o: [*o[:2], "=x", *o[2:]], "is not FILE or NAME=FILE"),
        (lambda o: [*o[:2], "nobody.txt", *o[2:]], "nobody.txt"),
    ],
)
def test_bad_input_is_one_line(files, capsys, tmp_path, monkeypatch, change, message) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(change(options(files))) == 2
    said = capsys.readouterr().err
    assert message in said
    assert not (tmp_path / "x").exists()
