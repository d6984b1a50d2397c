"""Results of an exploration: rows, tables and charts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.tables import Column, Table, format_number, make_table
from ms_slam_env.tuning.front import Point, front_of
from ms_slam_env.tuning.held_out import COMPARED
from ms_slam_env.tuning.objectives import FAILURE, METRICS, OTHERS, as_metrics, key_of

TITLE = "Design-space exploration"
ABOUT = (
    "Configurations of SLAM are tried out, each trial a run over the same sequences. The Pareto "
    "front holds those that no other one beats in every objective: left of it nothing is faster at "
    "the same error, below it nothing is more accurate in the same time. Chosen from the front: "
    "fastest, the least cost whose error is not above the default's; most accurate, the least "
    "error whose cost is not above the default's; knee, farthest below the line between the ends "
    "of the front, on logarithmic axes."
)
_SHOWN = (
    *("ate_m", "ate_max_m", "ate_worst_m", "ate_worst_ratio", "ext_ms", "mem_mb", "energy_j"),
    *("energy_model_j", "map_error_mm", "M_I", "M_D"),
)
_PARAMETERS_DRAWN = 4
_RATE = "keep_every"
_MEANS = "Means over the sequences."

Shares = Mapping[str, Mapping[str, float]]
_TRIALS_PER_PARAMETER = 10


@dataclass(frozen=True)
class Explored:
    """Results of an exploration.

    Attributes:
        objectives: names in ``METRICS``.
        clock: clock that measured time.
        parameters: names of the parameters.
        points: the finished trials.
        chosen: points of the front by purpose.
        reference: largest value of each objective that still counts.
        hypervolume: after each trial, as a share of the box up to the reference.
        importance: share of each parameter, by objective.
        held_out: lines of ``compare_configurations`` on sequences that it never saw.
        again: such lines for the default and the chosen ones on its own sequences.
        absent: lines about parameters of requested groups that this machine or the backend lacks.
        levels: trials that run-time adaptation may switch among, from fast to robust.
    """

    objectives: Sequence[str]
    clock: str
    parameters: Sequence[str]
    points: Sequence[Point]
    chosen: Mapping[str, Point]
    reference: Mapping[str, float]
    hypervolume: Sequence[float]
    importance: Shares
    held_out: Sequence[Mapping[str, Any]]
    again: Sequence[Mapping[str, Any]]
    absent: Sequence[str] = ()
    levels: Sequence[int] = ()

    def rows(self) -> list[dict[str, Any]]:
        """One row per trial."""
        return [
            {
                "spec": {"trial": point.number, "params": point.params},
                "result": {
                    **as_metrics(point.measured, self.clock),
                    **{"feasible": point.feasible, "on_front": point.on_front},
                    "is_default": point.is_default,
                },
                "error": None,
            }
            for point in self.points
        ]

    def tables(self) -> list[Table]:
        """The default, the chosen configurations and the front; held-out runs; importances."""
        found = [self._configurations()]
        if self.held_out:
            found.append(self._ratios_table(self.held_out, "Held-out sequences", _MEANS))
        if self.again:
            title = "Default and chosen, measured again"
            found.append(self._ratios_table(self.again, title, f"{_MEANS} {self._by_chance()}"))
        if self.importance:
            found.append(self._importance())
        return found

    def _configurations(self) -> Table:
        purposes = self._purposes()
        cost = self.objectives[1]
        shown = [p for p in self.points if p.on_front or p.number in purposes]
        shown.sort(key=lambda point: point.measured.get(cost) or 0.0)
        measured = [as_metrics(point.measured, self.clock) for point in shown]
        keys = [*(key_of(name, self.clock) for name in _SHOWN), *OTHERS[:3]]
        lines: list[dict[str, Any]] = [
            {
                "trial": point.number,
                "purpose": purposes.get(point.number, "front"),
                **{key: values.get(key) for key in keys},
                **{f"params.{name}": point.params[name] for name in self.parameters},
            }
            for point, values in zip(shown, measured, strict=True)
        ]
        known = [key for key in keys if any(values.get(key) is not None for values in measured)]
        values = [Column(f"params.{name}", "parameter_value", name) for name in self.parameters]
        return make_table(("trial", "purpose", *known, *values), lines, note=self._counts())

    def _purposes(self) -> dict[int, str]:
        """Trial number to its purposes, for example fastest and knee."""
        names: dict[int, list[str]] = {}
        default = [("default", point) for point in self.points if point.is_default]
        of_level = {f"level {k}": self._by_number(n) for k, n in enumerate(self.levels)}
        for name, point in (*default, *self.chosen.items(), *of_level.items()):
            names.setdefault(point.number, []).append(name.replace("_", " "))
        return {number: ", ".join(own) for number, own in names.items()}

    def _by_number(self, number: int) -> Point:
        return next(point for point in self.points if point.number == number)

    def _counts(self) -> str:
        box = ", ".join(
            f"{name} = {format_number(METRICS[name].told(value), 3)}"
            for name, value in self.reference.items()
        )
        volume = format_number(self.hypervolume[-1], 3) if self.hypervolume else "-"
        return (
            f"{len(self.points)} finished trials, "
            f"{sum(bool(point.measured.get(FAILURE)) for point in self.points)} of them failed, "
            f"{sum(point.feasible for point in self.points)} feasible, "
            f"{sum(point.on_front for point in self.points)} on the front; "
            f"hypervolume {volume} of the box up to {box}."
            + "".join(f" {line[0].upper()}{line[1:]}." for line in self.absent)
        )

    def _ratios_table(self, lines: Sequence[Mapping[str, Any]], title: str, note: str) -> Table:
        columns: list[Column | str] = ["configuration"]
        for name in COMPARED:
            key = key_of(name, self.clock)
            columns += [key, Column(f"{key}_ratio", "ratio_to_default", "of default's")]
        columns += ["worst_ate_ratio", "failed_runs", "sequences_count"]
        return make_table(columns, lines, title, note)

    def _by_chance(self) -> str:
        """Note on the chosen configurations that may be better than the default by chance."""
        if max(line["sequences_count"] for line in self.again) < 2:
            return "Of one sequence: whether chance made a difference is not known."
        lines = {line["configuration"]: line for line in self.again}
        doubtful = []
        for purpose, objective in zip(("most_accurate", "fastest"), self.objectives, strict=False):
            point, name = self.chosen.get(purpose), purpose.replace("_", " ")
            if point is None or point.is_default or objective not in COMPARED:
                continue
            key = key_of(objective, self.clock)
            if not lines[name][f"{key}_ratio"].high < 1:
                doubtful.append(f"{name} ({metric(key).heading})")
        found = f"it may have here: {', '.join(doubtful)}" if doubtful else "here it does not"
        return f"Where a ratio's 95 % interval contains 1 chance may have made it; {found}."

    def _importance(self) -> Table:
        columns = [Column(name, "importance", self._heading(name)) for name in self.importance]
        lines: list[dict[str, Any]] = [
            {"parameter": name, **{o: shares[name] for o, shares in self.importance.items()}}
            for name in by_importance(self.importance)
        ]
        trials, title = len(self.points), "Importance of the parameters"
        note = f"From {trials} trials."
        if trials < _TRIALS_PER_PARAMETER * len(lines):
            note = (
                f"From {trials} trials of {len(lines)} parameters, too few to rank them by: with "
                f"less than {_TRIALS_PER_PARAMETER} trials a parameter chance may decide the order."
            )
        return make_table(("parameter", *columns), lines, title, note)

    def charts(self) -> list[Chart]:
        """Pareto front, hypervolume, importance, error over parameters, held-out sequences."""
        trials = list(range(1, len(self.hypervolume) + 1))
        line = Series("hypervolume", trials, list(self.hypervolume), mode="lines")
        found = [
            Chart("pareto", "Pareto front", "One mark a trial.",
                  [self._front(cost, error) for error, cost in self._pairs()]),
            Chart("hypervolume", "Hypervolume over trials",
                  "Share of the box up to the reference that the front so far dominates.",
                  [Panel("trials", "hypervolume", [line])]),
        ]  # fmt: skip
        rates = sorted({point.params.get(_RATE, 1) for point in self.points})
        if len(rates) > 1:
            caption = "Feasible trials that none of the same frame rate beats."
            panel = self._by_rate(self.objectives[0], self.objectives[1], rates)
            found.insert(1, Chart("rates", "Fronts of the frame rates", caption, [panel]))
        if self.importance:
            names = by_importance(self.importance)
            marks = [
                Series(self._heading(o), [shares[name] for name in names], names, mode="markers")
                for o, shares in self.importance.items()
            ]
            caption = "Shares in what makes a good value, by PED-ANOVA."
            panel = Panel("importance", "", marks)
            found.append(Chart("importance", "Importance of the parameters", caption, [panel]))
            found.append(
                Chart("parameters", "Error over the most important parameters", "One mark a trial.",
                      [self._over(name) for name in names[:_PARAMETERS_DRAWN]])
            )  # fmt: skip
        if self.held_out:
            panels = [self._ratios(name) for name in COMPARED]
            caption = "Ratio to the default's mean over the sequences, with its 95 % interval."
            found.append(Chart("held_out", "Held-out sequences", caption, panels))
        return found

    def _front(self, cost: str, error: str) -> Panel:
        """Every trial by two objectives, as in Fig. 6 of Saeedi et al., ICRA 2017."""
        known = [
            p for p in self.points if None not in (p.measured.get(cost), p.measured.get(error))
        ]
        failed = [p for p in known if p.measured.get(FAILURE)]
        purposes = self._purposes()
        front = sorted((p for p in known if p.on_front), key=lambda p: p.measured[cost])
        groups: dict[str, list[Point]] = {
            "trial": [p for p in known if p.feasible and not (p.on_front or p.is_default)],
            "breaks a constraint": [p for p in known if not p.feasible and p not in failed],
            "failed": failed,
            "Pareto front": front,
            **{purposes[p.number]: [p] for p in known if p.number in purposes},
        }
        series = [
            Series(
                name,
                self._values(own, cost),
                self._values(own, error),
                mode="lines+markers" if own is front else "markers",
                text=[_description(point) for point in own],
            )
            for name, own in groups.items()
            if own
        ]
        return Panel(key_of(cost, self.clock), key_of(error, self.clock), series, "xy")

    def _pairs(self) -> list[tuple[str, str]]:
        return list(combinations(self.objectives, 2))

    def _by_rate(self, error: str, cost: str, rates: Sequence[int]) -> Panel:
        """The front at each frame rate, labelled with its divergence, as in Figs. 5 and 6."""
        series = []
        for every in rates:
            own = [p for p in self.points if p.params.get(_RATE, 1) == every and p.feasible]
            own = front_of(own, (error, cost))
            if own:
                x, y = self._values(own, cost), self._values(own, error)
                M_I = max(point.measured.get("M_I") or 0.0 for point in own)
                name = f"every {every}" + (f", M_I {format_number(M_I, 2)}" if M_I else "")
                series.append(Series(name, x, y, mode="lines+markers"))
        return Panel(key_of(cost, self.clock), key_of(error, self.clock), series, "xy")

    def _over(self, parameter: str) -> Panel:
        error = self.objectives[0]
        own = [point for point in self.points if point.measured.get(error) is not None]
        x = [point.params[parameter] for point in own]
        are_numbers = not any(isinstance(value, (str, bool)) for value in x)
        series = Series(
            "trial",
            x if are_numbers else [str(value) for value in x],
            self._values(own, error),
            mode="markers",
            text=[f"trial {point.number}" for point in own],
        )
        shown = "parameter_value" if are_numbers else ""
        return Panel(shown, key_of(error, self.clock), [series], "y", title=parameter)

    def _ratios(self, name: str) -> Panel:
        key = key_of(name, self.clock)
        lines = [line for line in self.held_out if line[key] is not None]
        ratios = [line[f"{key}_ratio"] for line in lines]
        series = Series(
            "",
            [ratio.value for ratio in ratios],
            [str(line["configuration"]) for line in lines],
            [ratio.low for ratio in ratios],
            [ratio.high for ratio in ratios],
            "markers",
        )
        return Panel("ratio_to_default", "", [series], "x", title=metric(key).heading)

    def _values(self, points: Iterable[Point], name: str) -> list[float]:
        return [METRICS[name].scale * point.measured[name] for point in points]

    def _heading(self, name: str) -> str:
        return metric(key_of(name, self.clock)).heading


def by_importance(importance: Shares) -> list[str]:
    """Names of the parameters, by importance for any objective, largest first."""
    names = next(iter(importance.values()))
    return sorted(names, key=lambda name: -max(shares[name] for shares in importance.values()))


def _description(point: Point) -> str:
    """Number and parameters of a trial."""
    values = [
        f"{name} {format_number(value, 3) if isinstance(value, float) else value}"
        for name, value in point.params.items()
    ]
    return ", ".join([f"trial {point.number}", *values])
