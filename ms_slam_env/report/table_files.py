"""Write tables for papers (LaTeX) and spreadsheets (CSV)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from ms_slam_env._runtime.output_files import write_text
from ms_slam_env.errors import unknown
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import Table, Value, format_value

_SPECIAL = {
    **{c: f"\\{c}" for c in "&%$#_{}"},
    **{"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"},
    **{"²": r"\textsuperscript{2}", "±": r"$\pm$", "<": r"\textless{}", ">": r"\textgreater{}"},
}


def as_latex(table: Table) -> str:
    """The table as a ``tabular`` with booktabs rules; title and note become the caption."""
    keys = [(column.name, column.key or column.name) for column in table.columns]
    caption = " ".join(f"{part.rstrip('.')}." for part in (table.title, table.note) if part)
    lines = [
        r"\begin{table}",
        r"\centering",
        *([rf"\caption{{{escaped(caption)}}}"] if caption else []),
        rf"\begin{{tabular}}{{l{'r' * (len(keys) - 1)}}}",
        r"\toprule",
        _row([column.label for column in table.columns]),
        r"\midrule",
        *(_row([format_value(row.get(name), key) for name, key in keys]) for row in table.rows),
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def as_csv(table: Table) -> str:
    """The table's values in full precision and in their stored units, with names as header.

    An interval takes three columns, ``NAME``, ``NAME_low`` and ``NAME_high``. Unknown values are
    empty; a time of something that never happened is ``inf``.
    """
    names = [column.name for column in table.columns]
    ranged = {n for n in names if any(isinstance(row.get(n), Interval) for row in table.rows)}
    header = [h for n in names for h in ((n, f"{n}_low", f"{n}_high") if n in ranged else (n,))]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for row in table.rows:
        writer.writerow([cell for n in names for cell in _cells(row.get(n), n in ranged)])
    return text.getvalue()


FORMATS = {"latex": ("tex", as_latex), "csv": ("csv", as_csv)}
"""Format to file extension and conversion function."""


def write_tables(tables: Sequence[Table], folder: Path, formats: Sequence[str]) -> None:
    """Write every table as ``table_1.tex``, ``table_1.csv`` and so on.

    Raises:
        InputError: an unknown format.
    """
    check_formats(formats)
    for name in dict.fromkeys(formats):
        ending, text = FORMATS[name]
        for number, table in enumerate(tables, start=1):
            write_text(folder / f"table_{number}.{ending}", text(table))


def check_formats(formats: Sequence[str]) -> None:
    """Refuse an unknown table format.

    Raises:
        InputError: unknown format; the message names the valid ones.
    """
    for name in formats:
        if name not in FORMATS:
            raise unknown("format of tables", name, FORMATS)


def escaped(text: str) -> str:
    """``text`` escaped for LaTeX."""
    return "".join(_SPECIAL.get(c, c) for c in " ".join(text.split()))


def _row(cells: Sequence[str]) -> str:
    return " & ".join(escaped(cell) for cell in cells) + r" \\"


def _cells(value: Value, ranged: bool) -> list[object]:
    if isinstance(value, Interval):
        return [_plain(x) for x in (value.value, value.low, value.high)]
    return [_plain(value), *(["", ""] if ranged else [])]


def _plain(value: Value) -> object:
    unknown_value = value is None or (isinstance(value, float) and math.isnan(value))
    return "" if unknown_value else value
