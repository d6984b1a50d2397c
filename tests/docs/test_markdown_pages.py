"""Tables of Markdown pages come from results, and the repository's pages are up to date."""

from __future__ import annotations

import json
import lzma
import shutil
from pathlib import Path

import pytest
from ms_slam_docs.markdown_pages import with_tables

from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.registry import RESULTS_VERSIONS
from ms_slam_env.report.results import pack_results, read_results, write_results
from ms_slam_env.report.tables import make_table

ROOT = Path(__file__).resolve().parents[2]
PAGE = "# Title\n\n<!-- results: {} -->\n{}<!-- end -->\n\nText.\n"


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """The root of a clone with one result and no page."""
    lines = [{"planner": name, "ate_m": k / 1000, "frames": k} for k, name in enumerate("abc", 1)]
    columns = ["planner", "ate_m", "frames"]
    tables = [make_table(columns, lines, note="A note."), make_table(["planner"], [], "Empty one")]
    write_results(tmp_path / "docs/results/x/results.json", "x", "X", "About.", tables)
    return tmp_path


def test_a_table_is_written_between_its_comments(clone: Path) -> None:
    (clone / "README.md").write_text(PAGE.format("x columns=ate_m,planner rows=2", "old\n"))
    arguments = ["docs", "--root", str(clone)]
    assert main([*arguments, "--check"]) == 1
    assert "old" in (clone / "README.md").read_text()
    assert main(arguments) == 0
    table = "\nA note.\n\n| ATE [mm] | planner |\n| --- | ---: |\n| 1.00 | a |\n| 2.00 | b |\n\n"
    expected = PAGE.format("x columns=ate_m,planner rows=2", table)
    assert (clone / "README.md").read_text() == expected
    assert main([*arguments, "--check"]) == 0


def test_a_long_note_is_wrapped_and_a_long_row_is_not(clone: Path) -> None:
    note, name = "A word. " * 20, "x" * 120
    tables = [make_table(["planner"], [{"planner": name}], note=note)]
    write_results(clone / "docs/results/x/results.json", "x", "X", "About.", tables)
    lines = with_tables(PAGE.format("x", ""), clone / "docs/results").split("\n")
    assert f"| {name} |" in lines
    assert max(len(line) for line in lines if not line.startswith("|")) <= 100
    assert " ".join(lines).count("A word.") == 20


def test_age_and_command_stand_with_the_table(clone: Path) -> None:
    path = clone / "docs/results/x/results.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"results_version": 1}))
    what = 'x/results.json table="Empty one" made_by=yes'
    for page, link in (
        ("README.md", "docs/experiments.md"),
        ("docs/results/a.md", "../experiments.md"),
    ):
        text = with_tables(2 * PAGE.format(what, ""), clone / "docs/results", str(clone / page))
        mark = f"*Results version 1, older than the code ([changes]({link}#results-versions)).*"
        assert text.count(mark) == 1  # the first says it
    assert "Made by `" in text


def test_a_long_comment_may_take_two_lines(clone: Path) -> None:
    folder = clone / "docs/results"
    one, two = (PAGE.format(f"x columns=ate_m,planner{gap}rows=2", "") for gap in (" ", "\n    "))
    head, _, table = with_tables(one, folder).partition("planner rows=2")
    assert with_tables(two, folder) == f"{head}planner\n    rows=2{table}"
    with pytest.raises(InputError, match="line 4: unknown table '7'"):
        with_tables(PAGE.format("x table=7\n    rows=2", ""), folder)


def test_the_versions_that_marks_lead_to_are_listed(clone: Path) -> None:
    page = "<!-- versions: results -->\n<!-- end -->\n"
    lines = with_tables(page, clone / "docs/results").split("\n")
    assert [line for line in lines if line[:3] in ("| 1", "| 6")] == [
        f"| {version} | {RESULTS_VERSIONS[version]} |" for version in (6, 1)
    ]


@pytest.mark.parametrize(
    ("page", "message"),
    [
        (PAGE.format("x table=7", ""), "line 3: unknown table '7'; valid choices: 0, 1, Empty one"),
        (PAGE.format("x columns=ate", ""), "line 3: unknown column 'ate'"),
        (PAGE.format("x colums=ate_m", ""), "line 3: unknown option 'colums'"),
        (PAGE.format("x rows=many", ""), "line 3: rows = 'many' is not a number"),
        (PAGE.format("x 'y", ""), "line 3: .*no closing quotation"),
        (PAGE.format("y", ""), "line 3: cannot read result"),
        ("<!-- results: x -->\n", "line 1: no <!-- end -->"),
        (PAGE.format("x", "<!-- results: x -->\n"), "line 3: no <!-- end --> before line 4"),
        ("\n<!-- end -->\n", "line 2: <!-- end --> without a start"),
    ],
)
def test_a_comment_that_says_nothing_useful_is_refused(
    clone: Path, page: str, message: str
) -> None:
    with pytest.raises(InputError, match=f"page, {message}"):
        with_tables(page, clone / "docs/results")


def test_packed_results_make_the_same_pages(
    clone: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results, away = clone / "docs/results", clone / "away"
    (results / "x/chart.png").write_bytes(b"new")
    shutil.move(results / "x", away)
    (results / "x").mkdir()
    (results / "x/chart.png").write_bytes(b"old")
    assert main(["docs", "--pack", str(away), str(results / "x")]) == 0
    assert "results.json.xz: " in capsys.readouterr().out
    packed = results / "x/results.json.xz"
    assert lzma.decompress(packed.read_bytes()) == (away / "results.json").read_bytes()
    assert (results / "x/chart.png").read_bytes() == b"new"
    assert sorted(path.name for path in (results / "x").iterdir()) == ["chart.png", packed.name]
    page = PAGE.format("x made_by=yes", "") + PAGE.format("x/results.json table=1", "")
    of_packed = with_tables(page, results)
    shutil.copy(away / "results.json", results / "x")
    packed.write_bytes(b"")  # what is not packed comes first
    assert with_tables(page, results) == of_packed


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"{}", "not a packed JSON file"),
        (lzma.compress(b"{}")[:-4], "cut short"),
        (lzma.compress(b"{"), "not a JSON file"),
        (lzma.compress(b"[" * 100_000), "nested too deeply"),
        (lzma.compress(b" " * 30_000_000, preset=0), "larger than 20 MB unpacked"),
    ],
)
def test_a_pack_of_a_stranger_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: bytes, message: str
) -> None:
    monkeypatch.setattr("ms_slam_env.report.results._MAX_BYTES", 20_000_000)
    (tmp_path / "results.json.xz").write_bytes(data)
    with pytest.raises(InputError, match=message):
        read_results(tmp_path / "results.json")


def test_what_is_no_result_is_not_packed(tmp_path: Path) -> None:
    for content, message in (("", "holds no results"), ("[]", "not a result")):
        if content:
            (tmp_path / "a.json").write_text(content)
        with pytest.raises(InputError, match=message):
            pack_results(tmp_path, tmp_path / "packed")
    assert not (tmp_path / "packed").exists()


def test_a_folder_without_pages_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["docs", "--root", str(tmp_path)]) == 2
    assert "holds no pages" in capsys.readouterr().err


def test_pages_of_the_repository_are_up_to_date() -> None:
    assert main(["docs", "--check", "--root", str(ROOT)]) == 0
