"""Error and time of one configuration at several divergences, as in Figs. 3 and 5 of the paper."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.report.charts import Chart, over_field, scatter
from ms_slam_env.report.tables import Grouping, Row, Table
from ms_slam_env.slam.configuration import SlamConfiguration, read_configuration
from ms_slam_env.tuning import SlamEvaluator
from ms_slam_env.tuning.objectives import FAILURE, as_metrics

METRICS = ("M_I", "M_D", "ate_m", "ate_max_m", "cpu_ms_median", "load_cpu_ms", "failed")


@dataclass(frozen=True)
class RateSpec:
    """One configuration on every n-th frame of a sequence.

    Attributes:
        sequence: a folder, or scene:seed[:word[+word ...]].
        keep_every: process one in this many frames.
        image_size: image size of the camera.
        frames: length of a whole rendered sequence.
        base: fields of the configuration.
    """

    sequence: str
    keep_every: int
    image_size: str = "160x120"
    frames: int = 90
    base: dict[str, Any] = field(default_factory=dict)

    def evaluator(self) -> SlamEvaluator:
        """The evaluator of the configuration."""
        return SlamEvaluator((self.sequence,), self.frames, image_size=self.image_size)


@dataclass(frozen=True)
class ExploreDivergence(Experiment):
    """Error and time at different divergences

    SLAM processes every n-th frame of hand-held sequences, which increases the divergence between
    processed frames (Saeedi et al., ICRA 2017, Figs. 3 and 5).
    """

    sequences: tuple[str, ...] = ("living_room:1000", "corridor:1001", "table:1002", "carpet:1003")
    """Folders, or scene:seed[:word[+word ...]]."""
    keep_every: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 10)
    """Process one in this many frames."""
    config: Path | None = None
    """Configuration file (YAML); by default that of the surfel backend."""
    image_size: str = "160x120"
    """Image size of the camera."""
    frames: int = 90
    """Length of a whole rendered sequence."""

    workers = 1  # times are measured

    def specs(self) -> list[RateSpec]:
        """Every sequence at every rate."""
        base = SlamConfiguration() if self.config is None else read_configuration(self.config)
        SlamEvaluator(self.sequences, self.frames, image_size=self.image_size)  # refuses bad input
        rates = [dataclasses.replace(base, keep_every=n).keep_every for n in self.keep_every]
        return self.each(RateSpec, sequence=self.sequences, keep_every=rates, base=(asdict(base),))

    @staticmethod
    def run(spec: RateSpec) -> dict[str, Any]:
        """Measure the configuration on the processed frames."""
        configuration = SlamConfiguration(**{**spec.base, "keep_every": spec.keep_every})
        evaluator = spec.evaluator()
        measured = evaluator.measure(configuration, spec.sequence)
        failed = bool(measured.get(FAILURE))
        return {**as_metrics(measured, evaluator.clock), "failed": failed}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per rate."""
        note = "Medians (of failures: the share) over sequences with their 95 % intervals."
        return [Grouping(("keep_every",), METRICS, count="recordings").table(rows, note=note)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Fig. 3, ATE against divergence, and Fig. 5, largest error against time; medians."""
        pairs = (("M_I", "ate_m", "xy"), ("cpu_ms_median", "ate_max_m", "y"))
        panels = [
            scatter(rows, x, y, "keep_every", log, label=lambda every: f"every {every}")
            for x, y, log in pairs
        ]
        medians = over_field(rows, "keep_every", METRICS[:-1], log=("ate_m", "ate_max_m"))
        caption = "Line: median over sequences; band: its 95 % interval."
        return [
            Chart("divergence", "Error against divergence and time", "One mark a run.", panels),
            Chart("rates", "Medians over the rate", caption, medians),
        ]
