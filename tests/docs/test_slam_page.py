"""The live loop of the page on SLAM runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from ms_slam_env.config import from_dict
from ms_slam_env.report.results import read_results
from ms_slam_env.slam.surfel import SurfelConfig

PAGE = Path(__file__).resolve().parents[2] / "docs/slam.md"
RECORDS = PAGE.parent / "results"


def test_the_live_loop_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    section = PAGE.read_text(encoding="utf-8").partition("## A live camera")[2]
    source = re.findall(r"^```python\n(.*?)^```", section, re.MULTILINE | re.DOTALL)[0]
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(source, "docs/slam.md", "exec"), names)
    said = capsys.readouterr().out.splitlines()
    assert sum("standard deviation" in line for line in said) == 39  # the first has none
    assert not any(line.startswith("lost") for line in said)
    assert said[-1] == "True"


def test_what_to_do_when_tracking_gets_lost_names_options_and_figures_of_records() -> None:
    text = PAGE.read_text(encoding="utf-8")
    (row,) = re.findall(r"^\| \*\*tracking gets lost\*\* \| (.*) \|$", text, re.MULTILINE)
    named = re.findall(r"`(\w+)=([^`]*)`", row)
    assert [name for name, _ in named] == ["check_slips", "motion_mask", "submaps"]
    for name, value in named:
        from_dict(SurfelConfig, {name: yaml.safe_load(value)})
    (judged,) = cells("robustness_hololens", "surfel")
    share, runs = re.findall(r"walk (\d+) % of (\d+) runs succeed", row)[0]
    assert (judged["runs judged"], first(judged["runs that succeed [%]"])) == (runs, share)
    off, atlas = cells("submaps", "return | off", "return | atlas")
    fall = re.findall(r"sudden turn fall from (\d+) % to ([\d.]+) %", row)
    assert fall == [(first(off["frames lost [%]"]), first(atlas["frames lost [%]"]))]


def first(cell: str) -> str:
    """A value without its interval."""
    return cell.split()[0]


def cells(record: str, *beginnings: str) -> list[dict[str, str]]:
    """Rows that begin so of a record's first table, by their headings."""
    results = read_results(RECORDS / record / "results.json.xz")
    lines = [line for line in results.as_markdown().splitlines() if line.startswith("| ")]
    headings = lines[0].strip("| ").split(" | ")
    rows = [next(ln for ln in lines if ln.startswith(f"| {text} |")) for text in beginnings]
    return [dict(zip(headings, row.strip("| ").split(" | "), strict=True)) for row in rows]
