"""What is committed under docs/results: of the one form, by known metrics, with its tables."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ms_slam_env.metrics.registry import check_keys
from ms_slam_env.report.results import Results, is_result, read_results

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "results"
PATHS = sorted(FOLDER.rglob("*.json"))


def is_converted(path: Path) -> bool:
    return is_result(json.loads(path.read_text(encoding="utf-8")))


RESULTS = [path for path in PATHS if is_converted(path)]


def test_every_file_is_a_result() -> None:
    assert [path for path in PATHS if path not in RESULTS] == []


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: str(path.relative_to(FOLDER)))
def test_a_result_can_be_read_and_its_tables_are_beside_it(path: Path) -> None:
    results = read_results(path)
    for row in results.rows:
        check_keys(row.get("result") or {})
    assert results.tables
    assert results.provenance.get("command"), "which command made it?"
    assert results.as_markdown() in tables_beside(path), "table.md says something else"
    tell_age(path, results)


def tables_beside(path: Path) -> list[str]:
    return [table.read_text(encoding="utf-8") for table in path.parent.glob("*.md")]


def tell_age(path: Path, results: Results) -> None:
    """Say which results are older than the code; they say so themselves above their tables."""
    if results.stale:
        print(f"{path.relative_to(FOLDER)}: {results.stale}")
