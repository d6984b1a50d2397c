"""The report as one HTML page: style, script, Plotly and data in it, nothing loaded."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from datetime import datetime, timezone
from html import escape
from importlib import resources

from ms_slam_env import __version__
from ms_slam_env.benchmark.report.blocks import (
    Block,
    Cell,
    Code,
    Figure,
    Pictures,
    Prose,
    Section,
    Table,
)
from ms_slam_env.errors import InputError

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:; base-uri 'none'; form-action 'none'"
)  # a browser that reads it loads nothing, whatever a result holds


def page(name: str, sections: Sequence[Section]) -> str:
    """The whole page.

    Raises:
        InputError: Plotly is not installed.
    """
    title = f"Report: {name}"
    has_figures = any(isinstance(b, Figure) for section in sections for b in section.blocks)
    scripts = f"<script>{plotly_source()}</script>" if has_figures else ""
    count = f"{len(sections)} result{'s' if len(sections) != 1 else ''}"
    now = datetime.now(timezone.utc)
    contents = _contents(sections) if len(sections) > 1 else ""
    body = "\n".join(
        _section(section, f"s{number}", len(sections) == 1)
        for number, section in enumerate(sections, start=1)
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{escape(title)}</title>
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
</main>
{scripts}
<script>{_asset("page.js")}</script>
</body>
</html>
"""


def plotly_source() -> str:
    """Plotly's library for browsers.

    Raises:
        InputError: Plotly is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise InputError("ms-slam report needs Plotly: pip install ms-slam-env[report]") from None
    source: str = get_plotlyjs()
    return source.replace("</script", "<\\/script")


def _contents(sections: Sequence[Section]) -> str:
    lines = "\n".join(
        f'<li><a href="#s{number}">{escape(s.title)} <small>{escape(s.kind)}</small></a></li>'
        for number, s in enumerate(sections, start=1)
    )
    return (
        '<nav aria-label="Contents"><details open><summary>Contents</summary>'
        f"<ol>{lines}</ol></details></nav>"
    )


def _section(section: Section, anchor: str, alone: bool) -> str:
    blocks = "\n".join(
        _block(block, f"{anchor}-{number}") for number, block in enumerate(section.blocks, start=1)
    )
    title, kind = section.title, f'<p class="kind">{escape(section.kind)}</p>'
    if alone:  # the page has the folder's name above
        title, kind = section.kind[:1].upper() + section.kind[1:], ""
    return f"""<section id="{anchor}" aria-labelledby="{anchor}-title">
<h2 id="{anchor}-title">{escape(title)}</h2>
{kind}
<p>{escape(section.about)}</p>
{blocks}
{_provenance(section)}
</section>"""


def _provenance(section: Section) -> str:
    if not section.provenance:
        return '<p class="note">The result does not say what made it.</p>'
    lines = []
    for label, text in section.provenance:
        shown = escape(text)
        if label in ("command", "commit"):
            shown = f"<code>{shown}</code>"
        lines.append(f"<dt>{escape(label)}</dt><dd>{shown}</dd>")
    return f'<h3>Made by</h3><dl class="provenance">{"".join(lines)}</dl>'


def _block(block: Block, anchor: str) -> str:
    if isinstance(block, Prose):
        return _prose(block)
    if isinstance(block, Table):
        return _table(block, anchor)
    if isinstance(block, Figure):
        return _figure(block, anchor)
    if isinstance(block, Code):
        return (
            f"<details><summary><code>{escape(block.name)}</code></summary>"
            f'<pre tabindex="0">{escape(block.text)}</pre></details>'
        )
    return _pictures(block)


def _prose(block: Prose) -> str:
    parts = block.text.split("`")
    if len(parts) % 2 == 0:  # an odd backquote is no code
        text = escape(block.text)
    else:
        text = "".join(
            f"<code>{escape(part)}</code>" if index % 2 else escape(part)
            for index, part in enumerate(parts)
        )
    return f"<h3>{text}</h3>" if block.heading else f"<p>{text}</p>"


def _table(table: Table, anchor: str) -> str:
    title = table.title or "Table"
    heads = "".join(
        f'<th scope="col" aria-sort="none"><button type="button">{escape(column)}</button></th>'
        for column in table.columns
    )
    body = "\n".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in table.rows)
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    parts = (
        f'{note}<div class="scroll" tabindex="0" role="region" aria-label="{escape(title)}">'
        f'<table id="{anchor}"><thead><tr>{heads}</tr></thead><tbody>\n{body}\n</tbody></table>'
        f"</div>{_meanings(table)}"
    )
    if table.folded:
        count = f"{len(table.rows)} row{'s' if len(table.rows) != 1 else ''}"
        summary = f"<summary>{escape(title)} <small>{count}</small></summary>"
        return f'<details class="table">{summary}{parts}</details>'
    caption = f"<h3>{escape(table.title)}</h3>" if table.title else ""
    return caption + parts


def _cell(cell: Cell) -> str:
    number = cell.number
    mark = "" if number is None or not math.isfinite(number) else f' class="n" data-n="{number!r}"'
    return f"<td{mark}>{escape(cell.text)}</td>"


def _meanings(table: Table) -> str:
    if not table.meanings:
        return ""
    lines = "".join(
        f"<dt>{escape(column)}</dt><dd>{escape(text)}</dd>"
        for column, text in table.meanings.items()
    )
    return (
        '<details class="meanings"><summary>What the columns mean</summary>'
        f"<dl>{lines}</dl></details>"
    )


def _figure(figure: Figure, anchor: str) -> str:
    data = [{"label": p.label, "data": p.data, "layout": p.layout} for p in figure.plots]
    content = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    choice = ""
    if len(figure.plots) > 1:
        options = "".join(
            f'<option value="{index}">{escape(plot.label)}</option>'
            for index, plot in enumerate(figure.plots)
        )
        choice = (
            f'<p class="choice"><label for="{anchor}-c">{escape(figure.choice)}</label> '
            f'<select id="{anchor}-c" autocomplete="off">{options}</select></p>'
        )
    return f"""<h3>{escape(figure.title)}</h3>
<figure class="plot" id="{anchor}">
{choice}<div class="canvas" role="img" aria-label="{escape(figure.title)}. {escape(figure.caption)}"
 style="height:{figure.height_px}px"></div>
<figcaption>{escape(figure.caption)}</figcaption>
<script type="application/json">{content}</script>
</figure>"""


def _pictures(block: Pictures) -> str:
    images = "\n".join(
        f'<figure><img loading="lazy" alt="{escape(picture.name)}" '
        f'src="data:{picture.media_type};base64,{base64.b64encode(picture.content).decode()}">'
        f"<figcaption>{escape(picture.name)}</figcaption></figure>"
        for picture in block.pictures
    )
    count = f"<small>{len(block.pictures)}</small>"
    opened = "" if block.folded else " open"
    return (
        f'<details class="pictures"{opened}><summary>Pictures in the folder {count}</summary>'
        f"{images}</details>"
    )


def _asset(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")
