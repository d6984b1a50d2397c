"""Write the tables of Markdown pages from committed results, so that pages and results agree.

A table stands between two comments, each on a separate line::

    <!-- results: planners table=0 columns=planner,ate_m,f_score_5cm -->
    <!-- end -->

The first word is a folder of results, whose ``results.json`` is read, or a JSON file in one,
compressed or not. Options:

- ``table``: number or title of a table; by default the first.
- ``columns``: names of the columns; by default all.
- ``where``: a column and its allowed texts, as in ``where=planner=a|b``.
- ``rows``: largest number of rows.
- ``made_by=yes``: add a line with the command.

A long comment may continue on a second line that is indented by four spaces.

If the result is older than the code, or was made with code that is in no commit, a warning stands
above the first of its tables on the page.

With ``agents:`` instead of ``results:``, the comment names policy files or folders of them,
relative to the root of the clone, and their model cards follow.

With ``leaders:``, the comment names folders of results of the planner benchmark and ``by=METRIC``.
The table says which planner leads each benchmark, and by how much.

With ``versions: results``, the table lists the results versions, to which those warnings link.
"""

from __future__ import annotations

import dataclasses
import re
import shlex
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path

from ms_slam_docs.leaders import leaders
from ms_slam_docs.model_cards import model_cards

from ms_slam_env._runtime.input_files import read_text
from ms_slam_env._runtime.output_files import write_text
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.metrics.registry import RESULTS_VERSIONS
from ms_slam_env.report.results import RESULTS, Results, made_by, read_results
from ms_slam_env.report.tables import Table

_START = re.compile(r"^<!-- (?P<kind>results|agents|leaders|versions): (?P<what>.*) -->$")
_CONTINUED = re.compile(r"^(<!-- \w+: [^\n]*)\n {4}([^\n]* -->)$", re.MULTILINE)
_END = "<!-- end -->"
_OPTIONS = ("table", "columns", "where", "rows", "made_by")


Mark = Callable[[Table], Table]
"""Adds to a stored table what has become known about its lines."""


def _unmarked(table: Table) -> Table:
    return table


def update_pages(
    pages: Iterable[Path], results: Path, write: bool = True, mark: Mark = _unmarked
) -> list[Path]:
    """Write the tables of Markdown pages; return the pages that were out of date.

    Args:
        pages: Markdown files.
        results: folder that contains the folders of results.
        write: whether to change the pages.
        mark: function applied to each table of results.

    Raises:
        InputError: a comment that names no table, or is not closed; the message says where.
    """
    changed = []
    for page in pages:
        before = read_text(page, "page")
        after = with_tables(before, results, str(page), mark)
        if after != before:
            changed.append(page)
            if write:
                write_text(page, after)
    return changed


def with_tables(text: str, results: Path, name: str = "page", mark: Mark = _unmarked) -> str:
    """``text`` with its tables rewritten from the results, each as ``mark`` returns it.

    Raises:
        InputError: see :func:`update_pages`.
    """
    lines: list[str] = []
    warned: set[Path] = set()  # results whose warning is already on the page
    opened = 0  # line number of the comment that opens a table
    number = 0
    for line in _CONTINUED.sub("\\1\0\\2", text).split("\n"):
        number += 1 + line.count("\0")
        start = _START.match(line.replace("\0", " "))
        if opened and start:
            raise InputError(f"{name}, line {opened}: no {_END} before line {number}")
        if line == _END and not opened:
            raise InputError(f"{name}, line {number}: {_END} without a start")
        if start:
            opened = number
            try:
                if start["kind"] == "agents":
                    inserted = _cards(start["what"], results, Path(name))
                elif start["kind"] == "leaders":
                    inserted = _leaders(start["what"], results, mark)
                elif start["kind"] == "versions":
                    inserted = _versions()
                else:
                    inserted = _inserted(start["what"], results, Path(name), warned, mark)
                lines += [line, "", *inserted.split("\n"), ""]
            except InputError as error:
                raise InputError(f"{name}, line {number}: {error}") from None
        elif line == _END:
            opened = 0
        if not opened:
            lines.append(line)
    if opened:
        raise InputError(f"{name}, line {opened}: no {_END}")
    return "\n".join(lines).replace("\0", "\n    ")


def _cards(what: str, results: Path, page: Path) -> str:
    """The model cards of the policies that a comment names."""
    root = results.parent.parent
    return model_cards([root / word for word in _words(what)], results, page).rstrip("\n")


def _leaders(what: str, folder: Path, mark: Mark) -> str:
    """Table of the leader of each result that a comment names, by the named metric."""
    names = _words(what)
    by = [name.removeprefix("by=") for name in names if name.startswith("by=")]
    if len(by) != 1 or len(names) < 2:
        raise InputError(f"{what!r}: must name folders of results and by=METRIC")
    found = [read_results(folder / name / RESULTS) for name in names if "=" not in name]
    return leaders(found, by[0], mark).as_markdown().rstrip("\n")


def _versions() -> str:
    """Table of the results versions, the newest first."""
    head = ["| version | what its algorithms do |", "| ---: | --- |"]
    versions = sorted(RESULTS_VERSIONS.items(), reverse=True)
    return "\n".join([*head, *(f"| {version} | {text} |" for version, text in versions)])


def _words(what: str) -> list[str]:
    try:
        return shlex.split(what)
    except ValueError as error:
        raise InputError(f"{what!r}: {str(error).lower()}") from None


def _inserted(what: str, folder: Path, page: Path, warned: set[Path], mark: Mark) -> str:
    """Text below a comment: a warning if the result is out of date, then note and table.

    Results in ``warned`` already have a warning on the page; a new one is added to it.
    """
    place, *words = _words(what)
    options = dict(word.partition("=")[::2] for word in words)
    for option in options:
        if option not in _OPTIONS:
            raise unknown("option", option, _OPTIONS)
    path = folder / place
    path = path if path.suffix == ".json" else path / RESULTS
    results = read_results(path)
    table = _cut(mark(_chosen(results, options.get("table", "0"))), options)
    caveats = results.short_caveats(page, folder.parent)
    parts = [f"*{caveats}*\n"] if caveats and path not in warned else []
    warned.add(path)
    parts.append(table.as_markdown())
    if options.get("made_by") == "yes":
        parts.append(made_by(results.provenance, results.rows))
    return "\n".join(_wrapped(line) for line in "\n".join(parts).rstrip("\n").split("\n"))


def _wrapped(line: str) -> str:
    """Wrap a line of a note to at most 100 characters; rows of tables are not changed."""
    is_row = line.startswith("|")
    return line if is_row else textwrap.fill(line, 100, break_long_words=False)


def _chosen(results: Results, which: str) -> Table:
    """The table with this number or title."""
    tables = {str(n): table for n, table in enumerate(results.tables)}
    tables |= {table.title: table for table in results.tables if table.title}
    if which not in tables:
        raise unknown("table", which, tables)
    return tables[which]


def _cut(table: Table, options: dict[str, str]) -> Table:
    """The requested columns and rows, without title, since the page has headings."""
    columns = {column.name: column for column in table.columns}
    names = options["columns"].split(",") if "columns" in options else list(columns)
    for name in names:
        if name not in columns:
            raise unknown("column", name, columns)
    column, _, wanted = options.get("where", "").partition("=")
    if column and column not in columns:
        raise unknown("column", column, columns)
    rows = [row for row in table.rows if not column or str(row.get(column)) in wanted.split("|")]
    count = options.get("rows", str(len(rows)))
    if not count.isdecimal():
        raise InputError(f"rows = {count!r} is not a number")
    chosen = tuple(columns[name] for name in names)
    return dataclasses.replace(table, title="", columns=chosen, rows=tuple(rows[: int(count)]))
