"""Write a folder of results as one self-contained HTML page, with style, scripts and data."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from html import escape as html_escape
from importlib import resources
from pathlib import Path
from typing import Any

from ms_slam_env import __version__
from ms_slam_env._runtime.input_files import read_bytes
from ms_slam_env._runtime.output_files import check_out_file, write_text
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.charts import Chart
from ms_slam_env.report.discovery import (
    MAX_PICTURE_BYTES,
    MAX_TEXT_BYTES,
    PICTURES,
    FoundResult,
    NotShown,
    find_results,
)
from ms_slam_env.report.plotly_charts import in_order, plots_of
from ms_slam_env.report.records import to_plain
from ms_slam_env.report.results import Results
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import Table, Value, format_value

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:; base-uri 'none'; form-action 'none'"
)  # keeps the browser from loading anything, whatever a result contains
_PROVENANCE = ("command", "time", "commit", "python", "versions", "platform", "cpu", "gpu")
_MAX_CONTENT = 100_000


def escape(text: str) -> str:
    """Escape text for the page, without characters that reorder letters."""
    return html_escape(in_order(text))


def write_report(folder: Path, out: Path | None = None) -> Path:
    """Write one self-contained page with every result in ``folder`` and below, atomically.

    Args:
        folder: results of any commands and experiments.
        out: the page; by default ``report.html`` in ``folder``.

    Returns:
        path of the page.

    Raises:
        InputError: no such folder, no result in it, Plotly not installed, or ``out`` cannot be a
            file.
    """
    target = folder / "report.html" if out is None else out
    check_out_file(target)
    found, absent = find_results(folder)
    write_text(target, page(folder.resolve().name, found, absent))
    return target


def page(name: str, found: Sequence[FoundResult], absent: Sequence[NotShown] = ()) -> str:
    """HTML of the whole page.

    Raises:
        InputError: Plotly is not installed.
    """
    has_charts = any(result.results.charts for result in found)
    scripts = f"<script>{_plotly_source()}</script>" if has_charts else ""
    count = f"{len(found)} result{'s' if len(found) != 1 else ''}"
    now = datetime.now(timezone.utc)
    contents = _contents(found) if len(found) > 1 else ""
    body = "\n".join(
        _section(result, f"s{number}", len(found) == 1)
        for number, result in enumerate(found, start=1)
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>Report: {escape(name)}</title>
<style>{_asset("page.css")}</style>
</head>
<body{' class="with-contents"' if contents else ""}>
<a class="skip" href="#main">Skip to the results</a>
<header>
<h1>{escape(name)}</h1>
<p>{count}, written <time datetime="{now:%Y-%m-%dT%H:%M:%SZ}">{now:%d %B %Y, %H:%M} UTC</time>
by <code>ms-slam report</code> {escape(__version__)}.</p>
<noscript><p>The figures need JavaScript; the tables hold the same numbers.</p></noscript>
</header>
{contents}
<main id="main">
{body}
{_not_shown(absent)}
</main>
{scripts}
<script>{_asset("page.js")}</script>
</body>
</html>
"""


def _asset(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")


def _plotly_source() -> str:
    """Source of Plotly's browser library.

    Raises:
        InputError: Plotly is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise InputError("ms-slam report needs Plotly: pip install ms-slam-env[report]") from None
    source: str = get_plotlyjs()
    return source.replace("</script", "<\\/script")


def _contents(found: Sequence[FoundResult]) -> str:
    lines = "\n".join(
        f'<li><a href="#s{number}">{escape(result.title)} '
        f"<small>{escape(result.results.title)}</small></a></li>"
        for number, result in enumerate(found, start=1)
    )
    return (
        '<nav aria-label="Contents"><details open><summary>Contents</summary>'
        f"<ol>{lines}</ol></details></nav>"
    )


def _not_shown(absent: Sequence[NotShown]) -> str:
    if not absent:
        return ""
    lines = "".join(
        f"<dt>{escape(missing.name)}</dt><dd>{escape(missing.reason)}</dd>" for missing in absent
    )
    return f'<section id="not-shown"><h2>Not shown</h2><dl>{lines}</dl></section>'


def _section(found: FoundResult, anchor: str, is_alone: bool) -> str:
    """Section of a result: charts, tables and neighbouring files; ``is_alone``: the only one."""
    results = found.results
    kind = results.title or results.kind
    title = kind if is_alone else found.title
    parts = [f'<h2 id="{anchor}-title">{escape(title)}</h2>']
    parts += [] if is_alone else [f'<p class="kind">{escape(kind)}</p>']
    parts += [f"<p>{escape(results.about)}</p>"] if results.about else []
    parts += [f'<p class="stale">{escape(results.caveats)}</p>'] if results.caveats else []
    charts = [chart for chart in results.charts if chart.panels]
    parts += [_chart(chart, charts, f"{anchor}-c{n}") for n, chart in enumerate(charts)]
    parts += [_table(table, f"{anchor}-t{n}") for n, table in enumerate(results.tables)]
    parts += [_pictures(found.pictures)] if found.pictures else []
    parts += [_rows(results, f"{anchor}-rows")] if results.rows else []
    parts += [
        _text(path.name, read_bytes(path, "text", MAX_TEXT_BYTES).decode(errors="replace"))
        for path in found.texts
    ]
    content = json.dumps(to_plain(results.content), indent=1, ensure_ascii=False)
    if results.content and len(content) <= _MAX_CONTENT:
        parts.append(_text(f"settings and values in {found.path.name}", content))
    parts.append(_provenance(results.provenance))
    inner = "\n".join(parts)
    return f'<section id="{anchor}" aria-labelledby="{anchor}-title">\n{inner}\n</section>'


def _chart(chart: Chart, beside: Sequence[Chart], anchor: str) -> str:
    plots = plots_of(chart, beside)
    data = [{"data": plot.data, "layout": plot.layout} for plot in plots]
    content = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    choice = ""
    if len(plots) > 1:
        options = "".join(
            f'<option value="{index}">{escape(plot.label)}</option>'
            for index, plot in enumerate(plots)
        )
        choice = (
            f'<p class="choice"><label for="{anchor}-choice">Shown</label> '
            f'<select id="{anchor}-choice" autocomplete="off">{options}</select></p>'
        )
    return f"""<h3>{escape(chart.title)}</h3>
<figure class="plot" id="{anchor}">
{choice}<div class="canvas" role="img" aria-label="{escape(chart.title)}. {escape(chart.caption)}"
 style="height:{max(plot.height_px for plot in plots)}px"></div>
<figcaption>{escape(chart.caption)}</figcaption>
<script type="application/json">{content}</script>
</figure>"""


def _table(table: Table, anchor: str) -> str:
    columns = [(column.name, column.key or column.name, column.label) for column in table.columns]
    rows = [[_cell(row.get(name), key) for name, key, _ in columns] for row in table.rows]
    title = f"<h3>{escape(table.title)}</h3>" if table.title else ""
    return title + _sortable(
        [label for *_, label in columns], rows, table.title, anchor, table.note, _meanings(table)
    )


def _sortable(
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    title: str,
    anchor: str,
    note: str = "",
    meanings: str = "",
) -> str:
    """A sortable table that scrolls within the page; its cells are already HTML."""
    heads = "".join(
        f'<th scope="col" aria-sort="none"><button type="button">{escape(heading)}</button></th>'
        for heading in headings
    )
    body = "\n".join(f"<tr>{''.join(row)}</tr>" for row in rows)
    said = f'<p class="note">{escape(note)}</p>' if note else ""
    return (
        f'{said}<div class="scroll" tabindex="0" role="region" '
        f'aria-label="{escape(title or "Table")}">'
        f'<table id="{anchor}"><thead><tr>{heads}</tr></thead><tbody>\n{body}\n</tbody></table>'
        f"</div>{meanings}"
    )


def _cell(value: Value, key: str) -> str:
    """A table cell, sorted by its number if it has one."""
    number = value.value if isinstance(value, Interval) else value
    mark = ""
    if isinstance(number, (int, float)) and not math.isnan(number):
        shown = number * metric(key).scale
        sign = "-" if shown < 0 else ""
        mark = f' class="n" data-n="{f"{sign}Infinity" if math.isinf(shown) else repr(shown)}"'
    text = escape(format_value(value, key))
    if isinstance(value, Interval):  # the interval may wrap below its value
        text = f"<span>{text.replace(' [', '</span> <span>[')}</span>"
    return f"<td{mark}>{text}</td>"


def _meanings(table: Table) -> str:
    """Explanation of each metric in the table; columns of the same metric share an entry."""
    headings: dict[str, list[str]] = {}
    for column in table.columns:
        headings.setdefault(column.key or column.name, []).append(column.label)
    lines = "".join(
        f"<dt>{escape(labels[0] if len(labels) == 1 else metric(key).label)}</dt>"
        f"<dd>{escape(metric(key).explanation)}</dd>"
        for key, labels in headings.items()
    )
    return (
        '<details class="meanings"><summary>What the columns mean</summary>'
        f"<dl>{lines}</dl></details>"
    )


def _rows(results: Results, anchor: str) -> str:
    """Collapsible table of every row of an experiment: inputs, results, errors.

    Series are left out, and inputs common to all rows are listed once, above the table.
    """
    lines = [
        {
            **{("spec", key): value for key, value in (row.get("spec") or {}).items()},
            **{("result", key): value for key, value in (row.get("result") or {}).items()},
            ("result", "error"): row.get("error"),
        }
        for row in results.rows
    ]
    names = dict.fromkeys(name for line in lines for name in line)
    shown = [name for name in names if all(_is_plain(line.get(name)) for line in lines)]
    same = [name for name in shown if len(lines) > 1 and _never_changes(lines, name)]
    shown = [name for name in shown if name not in same]
    note = ", ".join(f"{key} {lines[0][part, key]}" for part, key in same if part == "spec")
    known = {key for _, key in shown if _is_metric(key)}
    table = _sortable(
        [metric(key).label if key in known else key for _, key in shown],
        [
            [
                _cell(line.get(name), name[1]) if name[1] in known else _raw_cell(line.get(name))
                for name in shown
            ]
            for line in lines
        ],
        results.rows_key,
        anchor,
        f"The same in every row: {note}." if note else "",
    )
    count = f"{len(lines)} {results.rows_key}"
    return f'<details class="table"><summary>{escape(count)}</summary>{table}</details>'


def _is_plain(value: Any) -> bool:
    return value is None or isinstance(value, (str, int, float))


def _never_changes(lines: Sequence[Mapping[Any, Any]], name: tuple[str, str]) -> bool:
    return len({repr(line.get(name)) for line in lines}) == 1


def _is_metric(key: str) -> bool:
    """Whether the registry explains ``key``; other settings are shown by their plain name."""
    try:
        metric(key)
    except InputError:
        return False
    return True


def _raw_cell(value: Any) -> str:
    is_number = isinstance(value, (int, float)) and math.isfinite(value)
    mark = f' class="n" data-n="{float(value)!r}"' if is_number else ""
    return f"<td{mark}>{'-' if value is None else escape(str(value))}</td>"


def _text(name: str, text: str) -> str:
    return (
        f"<details><summary><code>{escape(name)}</code></summary>"
        f'<pre tabindex="0">{escape(text)}</pre></details>'
    )


def _pictures(paths: Sequence[Path]) -> str:
    images = "\n".join(
        f'<figure><img loading="lazy" alt="{escape(path.name)}" '
        f'src="data:{PICTURES[path.suffix.lower()]};base64,'
        f'{base64.b64encode(read_bytes(path, "picture", MAX_PICTURE_BYTES)).decode()}">'
        f"<figcaption>{escape(path.name)}</figcaption></figure>"
        for path in paths
    )
    return (
        '<details class="pictures" open><summary>Pictures in the folder '
        f"<small>{len(paths)}</small></summary>{images}</details>"
    )


def _provenance(provenance: Mapping[str, Any]) -> str:
    """Summary and details of a result's provenance."""
    lines = []
    for key in (*_PROVENANCE, *(key for key in provenance if key not in _PROVENANCE)):
        value = provenance.get(key)
        if isinstance(value, Mapping):
            value = ", ".join(f"{name} {version}" for name, version in value.items())
        if value not in (None, ""):
            shown = escape(str(value))
            shown = f"<code>{shown}</code>" if key in ("command", "commit") else shown
            lines.append(f"<dt>{escape(key.replace('_', ' '))}</dt><dd>{shown}</dd>")
    if not lines:
        return '<p class="note">The result does not say what made it.</p>'
    return f'<h3>Made by</h3><dl class="provenance">{"".join(lines)}</dl>'
