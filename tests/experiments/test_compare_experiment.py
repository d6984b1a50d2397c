"""``ms-slam compare``: bad input, medians, tables, a run from end to end."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.experiments import compare
from ms_slam_env.experiments.compare import METRICS, PEERS, Compare, CompareSpec, medians


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


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        ("sequences", ("table",), "neither a folder nor scene:seed"),
        ("sequences", ("table:x",), "neither a folder nor scene:seed"),
        ("sequences", ("table:1:fog",), "'fog'; valid choices: kinect"),
        ("sequences", ("table:1:none+fog",), "'fog'; valid choices: .*rolling-shutter"),
        ("sequences", ("no-such-scene:1",), "valid choices: living_room"),
        ("sequences", (), "Compare.sequences is empty"),
        ("backends", ("lidar",), "valid choices: surfel"),
        ("backends", ("surfel,icp",), "'icp' is not option=value"),
        ("image_sizes", ("3x3",), "valid choices"),
        ("frames", 1, "outside"),
        ("threads", 0, "outside"),
    ],
)
def test_bad_input_is_refused_before_anything_runs(
    argument: str, value: object, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Compare(**{argument: value})  # type: ignore[arg-type]


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


def test_medians_leave_out_what_a_backend_failed_on() -> None:
    (table,) = Compare().tables(ROWS)
    lines = [line for line in table.rows if line["sequence"] != "median"]
    assert [line["cpu_ms_median"] for line in lines if line["backend"] == "one"] == [1, 4, 100]
    assert [(line["backend"], line["cpu_ms_median"]) for line in medians(lines)] == [
        ("one", 2.5),
        ("two", 5.0),
    ]
    failed = next(line for line in lines if "error" in line)
    assert (failed["sequence"], failed["error"]) == ("c:1", "RuntimeError: no")
    assert "every backend finished" in table.note
    assert re.search(r"over \d of \d sequences, .* not ", table.note)
    (chart,) = Compare().charts(ROWS)
    assert [series.name for series in chart.panels[0].series] == ["one", "two"]


def test_energy_has_a_column_where_a_machine_counts_it() -> None:
    counted = [row("a:1", "one", 1.0, ene_frame_j=0.25), row("a:1", "two", 1.0)]
    names = [[c.name for c in Compare().tables(rows)[0].columns] for rows in (counted, ROWS)]
    assert ["ene_frame_j" in columns for columns in names] == [True, False]


def test_the_command_refuses_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "--backends", "lidar"]) == 2
    assert "unknown SLAM backend 'lidar'; valid choices: surfel" in capsys.readouterr().err
