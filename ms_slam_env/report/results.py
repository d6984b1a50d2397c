"""File format of results: kind, version, provenance, rows or metrics, tables, charts.

``results.json`` (``metrics.json`` for commands such as ``ms-slam run``) holds::

    {"kind": ..., "title": ..., "about": ..., "results_version": ..., "provenance": {...},
     "config": {...}, "rows": [{"spec": {...}, "result": {...}, "error": null, ...}, ...],
     "tables": [...], "charts": [...]}

``ms-slam report`` shows any file with a kind and tables, and needs nothing else.

A committed result consists of this file alone, compressed as ``results.json.xz``, since the other
files of the folder are made from it. Every reader accepts both forms.
"""

from __future__ import annotations

import lzma
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any

from ms_slam_env._runtime.input_files import is_named, parse_json, read_bytes, read_json
from ms_slam_env._runtime.output_files import check_out_folder, write_bytes, write_text
from ms_slam_env._runtime.result_folders import result_folder
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.registry import (
    RESULTS_VERSION,
    RESULTS_VERSIONS,
    check_keys,
    versions_since,
)
from ms_slam_env.report.charts import Chart, chart_from_json
from ms_slam_env.report.provenance import DIRTY, provenance
from ms_slam_env.report.records import check_plain, from_plain, to_plain, write_json
from ms_slam_env.report.sources import changed_parts, sources_of
from ms_slam_env.report.tables import Table, table_from_json

RESULTS = "results.json"
TABLE = "table.md"
PACKED = ".xz"
"""Suffix of a compressed result."""

_MAX_BYTES = 200_000_000


@dataclass(frozen=True)
class Results:
    """A result that was read from a file or will be written to one.

    Attributes:
        kind: name of the experiment or command.
        title: what was run, in a few words.
        about: what it shows, in one or two sentences.
        tables: tables, the most important first.
        charts: charts, the most important first.
        rows: rows of an experiment; empty for other results.
        rows_key: key of the rows in the file.
        content: everything else: configuration, metrics of a single run.
        provenance: command, versions, commit, machine, time.
        version: version of the algorithms that made it.
    """

    kind: str
    title: str
    about: str
    tables: Sequence[Table]
    charts: Sequence[Chart]
    rows: Sequence[Mapping[str, Any]]
    rows_key: str
    content: Mapping[str, Any]
    provenance: Mapping[str, Any]
    version: int = RESULTS_VERSION

    @property
    def changed(self) -> list[str]:
        """Parts whose code has changed since; empty for a result that does not record them."""
        return changed_parts(self.provenance.get("sources", {}), self.kind)

    @property
    def stale(self) -> str:
        """A warning if other code than today's made the result, otherwise empty."""
        changed = self.changed
        since = versions_since(self.version, self.kind)
        newer = "; ".join(f"version {version}: {text}" for version, text in since.items())
        parts = [
            f"These figures are older than the code of {', '.join(changed)}." if changed else "",
            f"These figures are older than the code (results version {self.version}, "
            f"{RESULTS_VERSIONS[self.version]}). Since then {newer}."
            if since
            else "",
        ]
        return " ".join(filter(None, parts))

    @property
    def uncommitted(self) -> str:
        """A warning if files differed from the recorded commit, otherwise empty."""
        rows = [str(row.get("commit")).endswith(DIRTY) for row in self.rows]
        if any(rows):
            return f"{sum(rows)} of {len(rows)} rows were made with code that is in no commit."
        is_dirty = str(self.provenance.get("commit")).endswith(DIRTY)
        return "Made with code that is in no commit." if is_dirty else ""

    @property
    def caveats(self) -> str:
        """Warnings about old or uncommitted code behind the result; empty if there are none."""
        return " ".join(filter(None, (self.stale, self.uncommitted)))

    def short_caveats(self, page: Path, docs: Path) -> str:
        """The caveats as Markdown for a page; a link to ``docs`` leads to what has changed."""
        link = os.path.relpath(docs / "experiments.md", page.parent)
        if changed := self.changed:
            what = f"Older than the code of {', '.join(changed)}"
        else:
            what = f"Results version {self.version}, older than the code"
        stale = f"{what} ([changes]({link}#results-versions))." if self.stale else ""
        return " ".join(filter(None, (stale, self.uncommitted)))

    def as_markdown(self) -> str:
        """The caveats, the tables, and their provenance, as Markdown."""
        parts = [f"*{self.caveats}*\n"] if self.caveats else []
        parts += [table.as_markdown() for table in self.tables]
        parts.append(made_by(self.provenance, self.rows))
        return "\n".join(parts)


def write_results(
    path: Path,
    kind: str,
    title: str,
    about: str,
    tables: Sequence[Table] = (),
    charts: Sequence[Chart] = (),
    rows: Sequence[Mapping[str, Any]] = (),
    rows_key: str = "rows",
    content: Mapping[str, Any] | None = None,
    metrics: Mapping[str, Any] | None = None,
    sources: Mapping[str, str] | None = None,
) -> Results:
    """Write a result file, atomically.

    Args:
        path: the file.
        kind: see :class:`Results`, also for the next arguments.
        title: title of the result.
        about: what it shows.
        tables: tables of metrics.
        charts: charts of metrics.
        rows: rows with a ``result``, whose keys are checked.
        rows_key: key of the rows in the file.
        content: configuration and other entries, not checked.
        metrics: flat metrics of a single run, at the top level of the file.
        sources: digests of the code that made it, by part; empty if unknown; by default of the code
            of today.

    Raises:
        InputError: a result with a key that the registry does not know.
    """
    check_keys(metrics or {})
    for row in rows:
        check_keys(row["result"] or {})
    if sources is None:
        sources = sources_of(kind, str(to_plain([content, [row.get("spec") for row in rows]])))
    made = {**provenance(), **({"sources": sources} if sources else {})}
    written = Results(kind, title, about, tables, charts, rows, rows_key, content or {}, made)
    write_json(
        path,
        {
            "kind": kind,
            "title": title,
            "about": about,
            "results_version": RESULTS_VERSION,
            **(metrics or {}),
            "provenance": written.provenance,
            **written.content,
            "tables": [table.as_json() for table in tables],
            "charts": [chart.as_json() for chart in charts],
            **({rows_key: rows, "rows_key": rows_key} if rows else {}),
        },
    )
    return written


def write_result_folder(
    out: Path, name: str, write_more: Callable[[Path], object] = lambda folder: None, **result: Any
) -> Results:
    """Write a result with its tables as Markdown and its charts as PNG, all or nothing.

    Args:
        out: folder of the result.
        name: name of the result file.
        write_more: writes further files into the folder that it is given.
        result: see `write_results`.

    Raises:
        InputError: a result with a key that the registry does not know.
        OSError: a file that cannot be written.
    """
    from ms_slam_env.report.figures import save_charts

    before = _figures_of(out / name)
    with result_folder(out, name) as folder:
        results = write_results(folder / name, **result)
        write_text(folder / TABLE, results.as_markdown())
        save_charts(results.charts, folder)
        write_more(folder)
    for figure in before - {f"{chart.name}.png" for chart in results.charts}:
        if Path(figure).name == figure:  # the old file may name a figure in another folder
            (out / figure).unlink(missing_ok=True)
    return results


def _figures_of(path: Path) -> set[str]:
    """Chart files of the previous result, which the new one may lack."""
    try:
        return (
            {f"{chart.name}.png" for chart in read_results(path).charts} if path.exists() else set()
        )
    except InputError:
        return set()


def read_results(path: Path) -> Results:
    """Read a result file, or its compressed form ``path.xz``.

    Raises:
        InputError: no such file, not a result, or keys that the registry does not know.
    """
    packed = path if path.suffix == PACKED else path.with_name(path.name + PACKED)
    try:
        if path == packed or (is_named(packed) and not is_named(path)):
            content = from_plain(_unpacked(packed))
        else:
            content = from_plain(read_json(path, "result", _MAX_BYTES))
    except RecursionError:
        raise InputError(f"{path} is not a result of ms-slam: it is nested too deeply") from None
    if not is_result(content):
        raise InputError(f"{path} is not a result of ms-slam: it has no kind and tables")
    try:
        rows_key = content.pop("rows_key", "rows")
        check_plain("rows_key", rows_key, (str,))
        return Results(
            kind=str(content.pop("kind")),
            title=str(content.pop("title", "")),
            about=str(content.pop("about", "")),
            tables=[_retitled(table_from_json(table)) for table in content.pop("tables")],
            charts=[chart_from_json(chart) for chart in content.pop("charts", [])],
            rows=_checked_rows(content.pop(rows_key, [])),
            rows_key=rows_key,
            version=_checked_version(content.pop("results_version", 1)),
            provenance=_checked_provenance(content.pop("provenance", {})),
            content=content,
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        if isinstance(error, InputError):
            raise InputError(f"{path}: {error}") from None
        raise InputError(f"{path} is not a result of ms-slam: {error!r}") from None


_RETITLED = {
    "Better than each other": "Share of pairs, by final F-score",
    "Sooner than each other": "Share of pairs, by area under the F-score",
    "Better rewarded than each other": "Share of pairs, by return",
    "Sooner from the same start": "Share of starts, by area under the F-score",
    "Policies as one": "Policies of each training pooled",
}
"""Titles of the planner benchmark's tables in older results, and their current titles."""


def _retitled(table: Table) -> Table:
    """``table`` with its current title; a task's name or another title may precede it."""
    parts = [_RETITLED.get(part, part) for part in table.title.split(": ")]
    return replace(table, title=": ".join(parts))


def _unpacked(path: Path) -> Any:
    """JSON of a compressed, untrusted file."""
    data = read_bytes(path, "result", _MAX_BYTES)
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MAX_BYTES)
    try:
        text = unpacker.decompress(data, max_length=_MAX_BYTES)
        if not unpacker.eof:
            raise lzma.LZMAError(f"cut short, or larger than {_MAX_BYTES / 1e6:.0f} MB unpacked")
    except lzma.LZMAError as error:
        raise InputError(f"{path} is not a packed JSON file: {error}") from None
    return parse_json(text, path)


def pack_results(source: Path, target: Path) -> list[Path]:
    """Write the results of folder ``source`` compressed into ``target``; return the written files.

    Other files that are in both folders (such as a picture that a page shows) are replaced.

    Raises:
        InputError: no result in ``source``, or a JSON file that is not a result.
    """
    files = {}
    for path in sorted(source.glob("*.json")):
        read_results(path)
        data = read_bytes(path, "result", _MAX_BYTES)
        files[f"{path.name}{PACKED}"] = lzma.compress(data, preset=lzma.PRESET_EXTREME)
    if not files:
        raise InputError(f"{source} holds no results")
    check_out_folder(target)
    names = [path.name for path in target.iterdir()] if target.is_dir() else []
    beside = [name for name in sorted(names) if name not in files and (source / name).is_file()]
    files |= {name: read_bytes(source / name, "file", _MAX_BYTES) for name in beside}
    target.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        write_bytes(target / name, data)
    return [target / name for name in files]


def _checked_rows(rows: Any) -> list[Mapping[str, Any]]:
    """Rows of a file, with the fields checked that tables and pages read."""
    for row in rows:
        for key in ("commit", "error"):
            check_plain(key, row.get(key), (str, NoneType))
        for key in ("spec", "result"):
            check_plain(key, row.get(key), (dict, NoneType))
            for number in (v for v in (row.get(key) or {}).values() if isinstance(v, int)):
                check_plain(key, number)
    return list(rows)


def _checked_version(version: Any) -> int:
    check_plain("results_version", version, (int,))
    return max(1, int(version))


def _checked_provenance(given: Any) -> dict[str, Any]:
    check_plain("provenance", given, (dict,))
    check_plain("commit", given.get("commit"), (str, NoneType))
    for key in ("versions", "sources"):
        check_plain(key, given.get(key, {}), (dict,))
    for digest in given.get("sources", {}).values():
        check_plain("sources", digest, (str,))
    return dict(given)


def is_result(content: Any) -> bool:
    """Whether JSON ``content`` has the form of a result."""
    return (
        isinstance(content, dict)
        and isinstance(content.get("kind"), str)
        and isinstance(content.get("tables"), list)
    )


def made_by(given: Mapping[str, Any], rows: Sequence[Mapping[str, Any]] = ()) -> str:
    """One line with the command, version, commits and machine that made a result."""
    commits = {row["commit"] for row in rows if row.get("commit")} or {given.get("commit")}
    known = sorted(commit for commit in commits if commit)
    version = given.get("versions", {}).get("ms-slam-env", "")
    return (
        f"Made by `{given.get('command', '')}`, version {version}"
        f"{''.join(f', commit {commit}' for commit in known)}, on {given.get('cpu', '')}.\n"
    )
