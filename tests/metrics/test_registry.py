"""The registry of metrics: every entry can be shown, and no two are mistaken for each other."""

from __future__ import annotations

import math
import re

import pytest

from ms_slam_env.errors import InputError
from ms_slam_env.metrics.registry import Metric, check_keys, metric, registry
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import format_value

METRICS = list(registry().values())
BASE_UNITS = {
    *("", "text", "flag", "share", "%", "count", "1000", "MB", "nats"),
    *("m", "cm", "mm", "rad", "deg", "mrad", "s", "ms", "min", "J", "W", "Hz"),
}
"""Units that others are made of, as in ``deg/m`` or ``m²``."""
SUFFIXES = {
    **{"deg_m": "deg/m", "deg_s": "deg/s", "m_s": "m/s"},
    **{"m": "m", "cm": "cm", "m2": "m²", "rad": "rad", "deg": "deg", "s": "s", "ms": "ms"},
    **{"j": "J", "w": "W", "mb": "MB", "share": "share"},
}
"""End of a key to the unit that its values are then stored in; the first that fits counts."""
NO_UNIT = re.compile(r"step_deg|.*(\d|\})cm")
"""Keys that end in a threshold, and a step of centimetres and degrees at once."""
ALIKE = {frozenset(("path_m", "path_length_m")), frozenset(("attempts", "attempts_count"))}
"""Keys that share a heading on purpose: the true length and the same where truth may lack, a list
and its length."""


def of_all(metrics: list[Metric]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("entry", metrics, ids=lambda entry: entry.key)


@of_all(METRICS)
def test_an_entry_says_what_it_is_in_words_and_known_units(entry: Metric) -> None:
    assert entry.heading == entry.heading.strip() != ""
    assert entry.definition.endswith(".")
    assert "mean" not in entry.definition.lower() or "median" not in entry.heading.lower()
    parts = {part.strip("²") for unit in (entry.unit, entry.shown) for part in unit.split("/")}
    assert parts <= BASE_UNITS
    assert math.isfinite(entry.scale)
    assert entry.better in ("", "lower", "higher")
    others = {"yaw and translation", "first pose", "first poses", "ICP", "none", ""}
    assert entry.alignment in {"SE(3)", "Sim(3)", *others}
    assert entry.digits > 0


@of_all(METRICS)
def test_a_key_is_lower_case_and_ends_in_its_unit(entry: Metric) -> None:
    assert re.fullmatch(r"(M|mean)_[ID]|T_[a-z_]+|[a-z]([a-z0-9_]|\{[a-z]+\})*", entry.key)
    if NO_UNIT.fullmatch(entry.key) or "_per_" in entry.key:
        return
    unit = next((u for end, u in SUFFIXES.items() if entry.key.endswith(f"_{end}")), entry.unit)
    assert entry.unit == unit


@of_all([entry for entry in METRICS if entry.unit not in ("text",)])
def test_numbers_of_a_metric_can_be_shown(entry: Metric) -> None:
    assert format_value(math.inf, entry.key) == "never"
    assert format_value(Interval(math.nan, math.nan, math.nan), entry.key) == "-"
    assert format_value(Interval(0.5, 0.25, 1.0), entry.key).endswith("]")
    assert entry.explanation.startswith(entry.definition)


@of_all(
    [
        entry
        for entry in METRICS
        if re.match(r"(ate|rpe|rer|lost|ext|cpu|mem|ene)_", entry.key)
        and not re.search(r"_(cut|gain)$", entry.key)
    ]
)
def test_errors_and_costs_are_better_when_lower(entry: Metric) -> None:
    assert entry.better == "lower" or entry.unit == "text"


def test_what_a_clock_or_a_meter_measures_cannot_be_repeated() -> None:
    measured = re.compile(r"by the clock|[Pp]rocessor time|[Mm]emory|RAPL|NVML")
    wrong = [entry.key for entry in METRICS if measured.search(entry.definition)]
    assert [key for key in wrong if metric(key).repeatable] == []


def test_headings_are_different_or_alike_on_purpose() -> None:
    by_label: dict[str, set[str]] = {}
    for entry in METRICS:
        by_label.setdefault(entry.label.lower(), set()).add(entry.key)
    shared = {frozenset(keys) for keys in by_label.values() if len(keys) > 1}
    assert shared - ALIKE == set()


def test_unaligned_errors_say_so_and_the_plain_ones_are_aligned() -> None:
    assert metric("ate_m").alignment == "SE(3)"
    for entry in METRICS:
        if entry.key.endswith("_unaligned_m"):
            assert entry.alignment == "none"


def test_a_threshold_is_part_of_a_key() -> None:
    assert metric("recall_3cm").label == "recall at 3 cm [%]"


@pytest.mark.parametrize(
    "result", [{"ate_mm": 1.0}, {"runs_": [{"ate_m": 1}]}, [{"ate_m": {"x": 1}}]]
)
def test_a_result_with_an_unknown_key_is_refused_at_any_depth(result: object) -> None:
    with pytest.raises(InputError, match="unknown metric"):
        check_keys(result)
