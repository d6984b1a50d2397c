"""Results in the text of pages come from records: every number with a unit is found in one.

A number outside the tables that ``ms-slam docs`` writes must be a value of a record that its page
names, rounded as it is printed: of its tables, or a median or share of its rows. What is no result
(an option, a size, the paper's figure), or is a result of another kind, stands in
``numbers_by_hand.txt``: after checking, ``python tests/docs/test_numbers.py`` rewrites it.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import astuple
from functools import cache
from pathlib import Path

import numpy as np

from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.results import read_results
from ms_slam_env.report.statistics import Interval

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "results"
PAGES = [ROOT / "README.md", *sorted(FOLDER.glob("*.md"))]
BY_HAND = Path(__file__).with_name("numbers_by_hand.txt")

_UNIT = r"(?:%|mm|cm|m|ms|s|mrad|rad|deg|degrees|nats)"
_NUMBER = r"-?\d[\d,]*(?:\.\d+)?"
_WITH_UNIT = re.compile(
    rf"(?<![\w.,/-])({_NUMBER})(?: ({_UNIT}))?(?: \[({_NUMBER}), ({_NUMBER})\])?(?![\w%])"
)


def test_every_number_of_a_page_is_of_a_record_or_listed() -> None:
    found = by_hand()
    listed = BY_HAND.read_text(encoding="utf-8").splitlines()
    new = [line for line in found if line not in listed]
    gone = [line for line in listed if line not in found]
    assert not new, f"in no record that the page names; see {Path(__file__).name}: {new}"
    assert not gone, f"no longer on the page, so run python {Path(__file__).name}: {gone}"


def test_a_number_that_is_in_no_record_is_found() -> None:
    page = FOLDER / "predicting-divergence.md"
    text = page.read_text(encoding="utf-8")
    table = read_results(FOLDER / "lookahead_ranking" / "results.json").tables[0]
    value = table.rows[0]["rank_correlation_depth"]
    assert isinstance(value, Interval)
    known = f"It is {value.value:.2f} [{value.low:.2f}, {value.high:.2f}], or 93 mm."
    assert list(strays(f"{text}\n{known}")) == [*strays(text), "93 mm"]
    wrong = f"It is {value.value:.2f} [{value.low - 0.5:.2f}, {value.high:.2f}]."
    assert len([*strays(f"{text}\n{wrong}")]) == len([*strays(text)]) + 1
    inside = "<!-- results: x -->\n\n93 mm\n\n<!-- end -->\n```sh\n93 mm\n```\nThen `93 mm`.\n"
    assert list(strays(text + inside)) == list(strays(text))


def by_hand() -> list[str]:
    """Page and number, for each that is in no record."""
    return [
        f"{page.relative_to(ROOT).as_posix()}: {number}"
        for page in PAGES
        for number in dict.fromkeys(strays(page.read_text(encoding="utf-8")))
    ]


def strays(text: str) -> Iterator[str]:
    """Numbers with a unit or an interval, outside tables and code, that no named record has."""
    named = re.findall(r"<!-- \w+: ([^>]*)-->|docs/results/(\w+)|--out results/(\w+)", text)
    names = {word for parts in named for part in parts for word in re.findall(r"\w+", part)}
    known = [value for name in sorted(names) for value in values_of(name)]
    prose = re.sub(r"(?ms)<!-- \w+:.*?<!-- end -->|^```.*?^```", "", text)
    prose = re.sub(r"(?m)`[^`]*`|\]\([^)]*\)|^\|.*$", "", prose)
    for match in _WITH_UNIT.finditer(" ".join(prose.split())):
        value, unit, *ends = match.groups()
        if (unit or ends[0]) and not any(is_printed((value, *ends), unit, one) for one in known):
            yield match[0]


_IN_BASE = {"mm": ("m", 1e-3), "cm": ("m", 1e-2), "ms": ("s", 1e-3), "mrad": ("rad", 1e-3)}
_IN_BASE |= {"deg": ("rad", np.pi / 180), "degrees": ("rad", np.pi / 180)}

Known = tuple[str, tuple[float, ...]]
"""Unit and value, or value, low and high."""


def is_printed(texts: tuple[str | None, ...], unit: str | None, known: Known) -> bool:
    """Whether a known value, or one with its interval, rounds to what is printed."""
    base, factor = _IN_BASE.get(unit or "", (unit or "", 1.0))
    parts = [text for text in texts if text is not None]
    if (unit and base != known[0]) or len(parts) > len(known[1]):
        return False
    for text, value in zip(parts, known[1], strict=False):
        half = 0.5000001 * 10.0 ** -len(text.partition(".")[2])
        if abs(abs(float(text.replace(",", ""))) - abs(value / factor)) > half:
            return False
    return True


@cache
def values_of(name: str) -> list[Known]:
    """Values of a record: of its tables, and medians, means and extremes of its rows."""
    found: list[Known] = []
    for path in sorted((FOLDER / name).glob("*.json.xz")):
        results = read_results(path)
        for table in results.tables:
            for column in table.columns:
                key = column.key or column.name
                found += [in_base(key, row[column.name]) for row in table.rows if
                          isinstance(row.get(column.name), (int, float, Interval))]  # fmt: skip
        rows = [row["result"] for row in results.rows if row.get("result")]
        for key in dict.fromkeys(key for row in rows for key in row):
            values = [row[key] for row in rows if isinstance(row.get(key), (int, float))]
            for statistic in (np.median, np.mean, np.min, np.max) if values else ():
                found.append(in_base(key, float(statistic(values))))
    return [(unit, values) for unit, values in found if np.isfinite(values).all()]


def in_base(key: str, value: Interval | float) -> Known:
    """A value of a metric in metres, seconds, radians or %."""
    shown = metric(key)
    unit, factor = _IN_BASE.get(shown.shown_unit, (shown.shown_unit, 1.0))
    parts = astuple(value) if isinstance(value, Interval) else (float(value),)
    return unit, tuple(shown.scale * factor * part for part in parts)


if __name__ == "__main__":
    BY_HAND.write_text("".join(f"{line}\n" for line in by_hand()), encoding="utf-8")
    sys.exit(0)
