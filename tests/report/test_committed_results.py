"""What is committed under docs/results: packed results by known metrics, and what pages show."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ms_slam_env.metrics.registry import check_keys
from ms_slam_env.report.discovery import find_results
from ms_slam_env.report.results import read_results

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "results"
PATHS = sorted(FOLDER.rglob("*.json.xz"))


@pytest.mark.parametrize("path", PATHS, ids=lambda path: str(path.relative_to(FOLDER)))
def test_a_result_can_be_read(path: Path) -> None:
    results = read_results(path)
    for row in results.rows:
        check_keys(row.get("result") or {})
    assert results.tables
    assert not [
        t.title for t in results.tables if re.search("as one|each other|[Ss]ooner", t.title)
    ]
    assert results.provenance.get("command"), "which command made it?"
    if results.stale:  # as it says above its tables
        print(f"{path.relative_to(FOLDER)}: {results.stale}")


def test_every_result_is_found_with_its_tables() -> None:
    found, absent = find_results(FOLDER)
    assert [one.path for one in found] == PATHS
    assert absent == []


def test_beside_results_lies_only_what_pages_and_commands_name() -> None:
    """Tables and figures are made of the results; `ms-slam docs --pack` leaves them out."""
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *FOLDER.glob("*.md")]
    texts = [page.read_text(encoding="utf-8") for page in pages]
    texts += [str(read_results(path).provenance.get("command")) for path in PATHS]
    named = "\n".join(texts)
    known = {*PATHS, *pages}
    others = [path for path in FOLDER.rglob("*") if path.is_file() and path not in known]
    places = [path.relative_to(FOLDER).as_posix() for path in others]
    assert [p for p in places if not re.search(rf"\b{re.escape(p)}\b", named)] == []
