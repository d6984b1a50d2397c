"""``ms-slam compare``: inputs, runs, memory, tables, bad input."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ms_slam_env.benchmark import compare_run
from ms_slam_env.benchmark.compare import Comparison, run_comparison
from ms_slam_env.benchmark.compare_report import medians, summarise, tables
from ms_slam_env.benchmark.compare_run import CompareSpec, run_apart
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError

RESULT = dict.fromkeys(
    [
        "ate_m",
        "ate_max_m",
        "ate_unaligned_m",
        "rpe_m",
        "rpe_rad",
        "lost",
        "map_error_mm",
        "f_2cm",
        "cpu_ms",
        "cpu_ms_p95",
        "ms",
        "memory_mb",
    ],
    1.0,
)


def row(sequence: str, backend: str, value: float | None, error: str | None = None) -> dict:
    spec = {"sequence": sequence, "backend": backend, "image_size": "160x120", "params": {}}
    result = None if error else RESULT | {"cpu_ms": value}
    return {"key": f"{sequence}{backend}{value}", "spec": spec, "result": result, "error": error}


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        ("sequences", ("table",), "neither a folder nor scene:seed"),
        ("sequences", ("table:x",), "neither a folder nor scene:seed"),
        ("sequences", ("table:1:fog",), "'fog'; valid choices: kinect"),
        ("sequences", ("table:1:none+fog",), "'fog'; valid choices: .*rolling-shutter"),
        ("sequences", ("attic:1",), "valid choices: living_room"),
        ("sequences", (), "Comparison.sequences is empty"),
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
        Comparison(**{argument: value})  # type: ignore[arg-type]


def test_a_run_in_a_process_of_its_own_and_its_table(tmp_path: Path) -> None:
    config = Comparison(("table:1000:none+exposure-ramp",), ("surfel",), ("80x60",), frames=12)
    text, failed = run_comparison(config, tmp_path, workers=1)
    assert failed == []
    assert text.count("| table:1000:none+exposure-ramp | surfel |") == 1
    content = json.loads((tmp_path / "compare.json").read_text())
    result = content["runs"][0]["result"]
    assert result["frames"] == 12
    assert result["ate_unaligned_m"] < 0.01
    assert result["lost"] == 0
    assert result["map_error_mm"] < 10
    assert result["precision_5cm"] > 0.99
    assert 0 < result["cpu_ms"] <= result["cpu_ms_p95"]
    assert 0 < result["ext_ms_median"] <= result["ext_ms_max"]
    assert result["memory_mb"] == result["mem_peak_mb"]
    assert (tmp_path / "compare.png").stat().st_size > 1000
    # The same here, to the last bit; and a second call takes what is there.
    here = compare_run.run_here(CompareSpec(**content["runs"][0]["spec"]))
    assert {k: here[k] for k in ("ate_m", "rpe_m", "points")} == {
        k: result[k] for k in ("ate_m", "rpe_m", "points")
    }
    before = (tmp_path / "episodes.jsonl").read_bytes()
    assert run_comparison(config, tmp_path, workers=1)[0] == text
    assert (tmp_path / "episodes.jsonl").read_bytes() == before


def test_what_goes_wrong_in_the_process_is_said_here() -> None:
    bad = CompareSpec("table:1000", "surfel", "80x60", {"icp_rgb_weight": 7}, frames=10)
    with pytest.raises(InputError, match=r"^SurfelConfig.icp_rgb_weight = 7 is outside \[0, 1\]$"):
        run_apart(bad)


def test_medians_leave_out_what_a_backend_failed_on() -> None:
    rows = [
        row("a:1", "one", 1.0),
        row("a:1", "two", 4.0),
        row("b:1", "one", 3.0),
        row("b:1", "one", 5.0),
        row("b:1", "two", 6.0),
        row("c:1", "one", 100.0),
        row("c:1", "two", None, "RuntimeError: no"),
    ]
    summary = summarise(rows)
    assert [cell["cpu_ms"] for cell in summary if cell["backend"] == "one"] == [1.0, 4.0, 100.0]
    assert [(cell["backend"], cell["cpu_ms"]) for cell in medians(summary)] == [
        ("one", 2.5),
        ("two", 5.0),
    ]
    text = tables(summary)
    assert "- two on c:1 failed: RuntimeError: no" in text
    assert "| c:1 | two | failed |" in text


def test_energy_has_a_column_where_a_machine_counts_it() -> None:
    rows = [row("a:1", "one", 1.0), row("a:1", "two", 1.0)]
    rows[0]["result"] |= {"ene_frame_j": 0.25, "ene_source": "cpu: RAPL"}
    rows[1]["result"] |= {"ene_frame_j": None, "ene_source": "cpu: not available"}
    text = tables(summarise(rows))
    assert "energy [J] |" in text
    assert "| 1.00 | 0.250 |" in text
    assert "energy" not in tables(summarise([row("a:1", "one", 1.0), rows[1]]))


def test_the_command_refuses_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "--backends", "lidar"]) == 2
    assert "unknown SLAM backend 'lidar'; valid choices: surfel" in capsys.readouterr().err
