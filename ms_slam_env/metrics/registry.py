"""The metric registry: heading, unit and definition of every key of a result.

The entries are in ``registry.yaml`` beside this file. Code that writes a result checks its keys
here, and every table, figure and report takes headings, units and explanations from here.
"""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from ms_slam_env._runtime.extension import ExtensionPoint
from ms_slam_env.errors import InputError, unknown

RESULTS_VERSIONS = {
    1: "results without a recorded version, by algorithms and measures that have changed",
    2: "algorithms of release 0.1; maps are compared with the true surface in SLAM's depth range",
    3: "near planes keep their normals, far depth is weighted, doubtful frames are checked twice",
    4: "normals are weighted exactly, frames beyond doubt are checked once, planners use their own "
    "random seeds",
    5: "environments have M_I = 0.15 and M_D = 0.36, and align frames again that may have slipped",
    6: "SLAM judges alignments by the noise of the recording, uses features for frames that fit "
    "badly, and by default masks moving things and continues in submaps when lost",
    7: "robustness errors only where every loss was joined, noise by the distance from the true "
    "surface, true surfaces of the USME suite sampled by area, its way without a loop without "
    "overlap, orbits whose laps differ",
}
"""Version to a description of its algorithms.

Add a version whenever a change of algorithms changes the numbers of an experiment.
"""
RESULTS_VERSION = max(RESULTS_VERSIONS)

_OF_ENVIRONMENTS = (
    *("arm_experiment", "arm_masks", "env_speed", "lookahead_ranking"),
    *("paper_table2", "planners", "pose_sources", "step_size", "team_mapping", "train"),
)
CHANGED_KINDS = {
    5: _OF_ENVIRONMENTS,
    7: ("evaluation", "multi_robot", "orbit", "usme"),
}
"""Version to the kinds of results that it changed; a version not listed here changed all."""


def versions_since(version: int, kind: str) -> dict[int, str]:
    """Later versions that changed this kind of results, with a description of their algorithms."""
    return {
        newer: text
        for newer, text in RESULTS_VERSIONS.items()
        if newer > version and kind in CHANGED_KINDS.get(newer, (kind,))
    }


STATISTICS = {
    "mean": "mean",
    "median": "median",
    "std": "standard deviation",
    "variance": "variance",
    "min": "smallest",
    "max": "largest",
}
"""Values of ``{statistic}`` in a key to their wording in heading and definition."""

_FAMILIES = {
    "{number}": r"(?<=_)\d+(?:\.\d+)?(?=cm$)",
    "{statistic}": rf"(?<=_)({'|'.join(STATISTICS)})(?=_|$)",
}
"""Placeholder in a registry key to the pattern of what may replace it."""

_SCALES = {
    ("m", "mm"): 1e3,
    ("m", "cm"): 1e2,
    ("rad", "deg"): 180 / math.pi,
    ("rad", "mrad"): 1e3,
    ("s", "ms"): 1e3,
    ("share", "%"): 1e2,
    ("count", "1000"): 1e-3,
}


POINT = ExtensionPoint("metrics", "ms_slam_env.metrics", form="module:function", takes=())
"""Extension point for more entries: functions that return a mapping like that of the file."""

EXTRA_METRICS = "MS_SLAM_METRICS"
"""Environment variable with more sources, comma-separated: YAML files or ``module:function``."""


@dataclass(frozen=True)
class Metric:
    """One key of a result.

    Attributes:
        key: name in JSON files; it ends in the unit where the unit is not obvious.
        heading: column or axis heading, without unit.
        definition: one or two sentences for a reader who does not know the metric.
        unit: unit of stored values: ``m``, ``share`` (0 to 1), ``count``, ``flag`` (true or
            false), ``text`` and so on; empty for a number without unit.
        shown: unit in tables and figures; ``unit`` if empty.
        alignment: how trajectories or maps are aligned before comparison: ``SE(3)``, ``none``, ...
        better: ``lower`` or ``higher``; empty if neither is.
        source: paper and equation, or another place that defines it.
        digits: significant digits shown.
        repeatable: whether the same code reproduces the value; false for times and energies.
    """

    key: str
    heading: str
    definition: str
    unit: str = ""
    shown: str = ""
    alignment: str = ""
    better: str = ""
    source: str = ""
    digits: int = 2
    repeatable: bool = True

    @property
    def shown_unit(self) -> str:
        """Unit in tables and figures; empty for counts, texts and pure numbers."""
        unit = self.shown or {"share": "%", "flag": "%"}.get(self.unit, self.unit)
        return "" if unit in ("count", "text") else unit

    @property
    def scale(self) -> float:
        """Factor from the stored to the shown unit."""
        shown = self.shown_unit
        stored = "share" if self.unit == "flag" else self.unit
        return 1.0 if shown in ("", stored) else _SCALES[stored, shown]

    @property
    def label(self) -> str:
        """Heading with the shown unit, for a column or an axis."""
        unit = self.shown_unit
        return f"{self.heading} [{unit}]" if unit else self.heading

    @property
    def explanation(self) -> str:
        """Definition with alignment, direction and source."""
        parts = [self.definition]
        if self.alignment:
            aligned = "No alignment" if self.alignment == "none" else f"Alignment: {self.alignment}"
            parts.append(f"{aligned}.")
        if self.better:
            parts.append(f"{self.better.capitalize()} is better.")
        if self.source:
            parts.append(f"Source: {self.source}.")
        return " ".join(parts)


@cache
def registry() -> Mapping[str, Metric]:
    """All metrics by key, in the order of the file.

    Includes those of entry points and of the variable ``MS_SLAM_METRICS``.

    Raises:
        InputError: a malformed entry, a unit that cannot be converted to the shown one, or a key
            of ours with another meaning.
    """
    text = resources.files(__package__).joinpath("registry.yaml").read_text(encoding="utf-8")
    own = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    metrics = {key: _metric(key, entry) for key, entry in own.items()}
    sources = [*POINT.names(), *filter(None, os.environ.get(EXTRA_METRICS, "").split(","))]
    for source in sources:
        for key, entry in _more(source).items():
            if key in metrics and metrics[key] != _metric(key, entry):
                raise InputError(f"metric {key!r} of {source} is already defined differently")
            metrics[key] = _metric(key, entry)
    return metrics


def _more(source: str) -> Mapping[str, Any]:
    """Entries from a YAML file, or from a function (entry point or ``module:function``)."""
    try:
        is_file = source.lower().endswith((".yaml", ".yml"))
        found = (
            yaml.safe_load(Path(source).read_text(encoding="utf-8"))
            if is_file
            else POINT.find(source)()
        )
    except (OSError, yaml.YAMLError) as error:
        raise InputError(f"metrics {source}: {' '.join(str(error).split())}") from None
    if not isinstance(found, Mapping):
        raise InputError(f"metrics {source}: no mapping of keys to entries")
    return found


def _metric(key: str, entry: Any) -> Metric:
    known = {field.name for field in fields(Metric)}
    if not isinstance(entry, Mapping) or not {"heading", "definition"} <= set(entry) <= known:
        names = ", ".join(sorted(known - {"key"}))
        raise InputError(f"metric {key!r}: needs heading and definition, and takes {names}")
    made = Metric(**{**entry, "key": key})
    if made.better not in ("", "lower", "higher"):
        raise unknown(f"better of metric {key!r}", made.better, ("lower", "higher"))
    try:
        made.scale  # noqa: B018 -- raises KeyError if the unit cannot be converted
    except KeyError:
        raise InputError(f"metric {key!r}: {made.unit} cannot be shown in {made.shown}") from None
    return made


def metric(key: str) -> Metric:
    """The metric with this key.

    Raises:
        InputError: unknown key; the message names similar ones.
    """
    found = registry().get(key) or _of_a_family(key)
    if found is None:
        similar = difflib.get_close_matches(key, registry(), n=3)
        hint = f"; similar: {', '.join(similar)}" if similar else ""
        raise InputError(
            f"unknown metric {key!r}: neither in metrics/registry.yaml nor in {EXTRA_METRICS}{hint}"
        )
    return found


def _of_a_family(key: str) -> Metric | None:
    """The metric of a key such as ``recall_3cm`` or ``rpe_mean_m``.

    An entry with a placeholder, such as ``recall_{number}cm``, covers all keys of its form.
    """
    for blank, pattern in _FAMILIES.items():
        for part in re.finditer(pattern, key):
            found = registry().get(f"{key[: part.start()]}{blank}{key[part.end() :]}")
            if found is not None:
                word = STATISTICS.get(part[0], part[0])
                heading, definition = (
                    text.replace(blank, word) for text in (found.heading, found.definition)
                )
                return replace(found, key=key, heading=heading, definition=definition)
    return None


def check_keys(result: Any) -> None:
    """Refuse a result that contains, at any depth, a key unknown to the registry.

    Raises:
        InputError: unknown key, which the message names.
    """
    if isinstance(result, Mapping):
        for key, value in result.items():
            metric(key)
            check_keys(value)
    elif isinstance(result, (list, tuple)):
        for value in result:
            check_keys(value)
