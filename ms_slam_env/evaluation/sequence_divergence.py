"""Difficulty of sequences: statistics of the divergence between consecutive frames.

Saeedi et al., ICRA 2017, section V-C and Table I: "assigning statistics of the information
divergence, such as mean and variance, to the sequence"; "evaluated per unit of time".
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.progress import Bar
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.divergence import MEASURES, DivergenceConfig, make_divergence
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.evaluation.observation_distance import observation_distance
from ms_slam_env.evaluation.trajectory_charts import thinned
from ms_slam_env.geometry import invert
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.results import Results, write_result_folder
from ms_slam_env.report.tables import Table, Value, make_table
from ms_slam_env.sequences import Sequence as RGBDSequence
from ms_slam_env.sequences.recording import Recording

KINDS = ("intensity", "depth")
WASSERSTEIN = "wasserstein"
"""The measure of `observation_distance`, which needs true poses."""
ALL_MEASURES = (*MEASURES, WASSERSTEIN)
_UNITS: Mapping[str, Mapping[str, str]] = {
    "earth-movers": {"intensity": "share of the grey range", "depth": "rad"},
    WASSERSTEIN: {"observation": "m"},
}
"""Units, by kind, of the measures that are not divergences in nats."""
_WORST = 3  # frames of each kind listed as worst

_ABOUT = (
    "How far each frame's histogram of intensity, and of depth, diverges from that of the frame "
    "before: a sequence of large divergence is hard to track (ICRA 2017, Table I)."
)


@dataclass(frozen=True)
class SequenceDivergence:
    """Divergences of a sequence.

    Attributes:
        name: of the sequence.
        times: (T,) seconds of the later frame of each pair, from the first frame on.
        divergences: (T, 2) intensity, depth, nats; intensity is NaN where there is no colour.
        gaps_s: (T,) seconds between the two frames of each pair.
        frames: (T,) number, in the whole sequence, of the later frame of each pair.
        files: (T,) name of its depth image; empty for a rendered sequence.
        measure: one of ``ALL_MEASURES``. With ``earth-movers`` intensity is a share of the grey
            range and depth an angle; ``wasserstein`` has one column, metres.
    """

    name: str
    times: Float64
    divergences: Float64
    gaps_s: Float64
    frames: NDArray[np.int64]
    files: Sequence[str]
    measure: str = MEASURES[0]

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each column of ``divergences``."""
        return tuple(self.units) or KINDS

    @property
    def units(self) -> Mapping[str, str]:
        """Unit by kind; empty if all are in nats."""
        return _UNITS.get(self.measure, {})

    @property
    def word(self) -> str:
        """Word for the values in registry keys."""
        return "distance" if self.units else "divergence"

    def statistics(self) -> dict[str, dict[str, float | None]]:
        """Statistics of each kind: ``max, mean, variance, std`` per frame, ``..._per_s`` of rates.

        A rate is a divergence divided by the time between its two frames, nats/s. Mean and variance
        of the rates are weighted by that time, so the mean is the sum of all divergences over the
        total time. None without colour.
        """
        return {
            kind: statistics_of(self.divergences[:, column], self.gaps_s)
            for column, kind in enumerate(self.kinds)
        }


def statistics_of(values: Float64, gaps_s: Float64) -> dict[str, float | None]:
    """Statistics of divergences (T,) between frames ``gaps_s`` (T,) apart, as described above.

    Leaves out pairs with unknown divergence; None if no pair is left.
    """
    known = ~np.isnan(values)
    if known.any():
        values, gaps_s = values[known], gaps_s[known]
    rates = values / gaps_s
    mean_rate = values.sum() / gaps_s.sum()
    rate_variance = np.average((rates - mean_rate) ** 2, weights=gaps_s)
    numbers = {
        "max": values.max(),
        "mean": values.mean(),
        "variance": values.var(),
        "std": values.std(),
        "max_per_s": rates.max(),
        "mean_per_s": mean_rate,
        "variance_per_s": rate_variance,
        "std_per_s": np.sqrt(rate_variance),
    }
    return {name: None if np.isnan(v) else float(v) for name, v in numbers.items()}


def consecutive_divergences(
    frames: Iterable[RGBDFrame], intrinsics: Intrinsics, configs: Sequence[DivergenceConfig]
) -> Float64:
    """Divergences (T, C, 2) between T + 1 consecutive frames, for C configurations."""
    measures = [make_divergence(config, intrinsics) for config in configs]
    previous = None
    rows = []
    for frame in frames:
        grey = intensity_image(frame.color).astype(np.float32)
        histograms = [m.histograms(grey[None], frame.depth[None]) for m in measures]
        if previous is not None:
            triples = zip(measures, histograms, previous, strict=True)
            rows.append([m.divergence(now, before)[0] for m, now, before in triples])
        previous = histograms
    return np.array(rows).reshape(-1, len(measures), len(KINDS))


def consecutive_distances(
    frames: Iterable[RGBDFrame], poses: Float64, intrinsics: Intrinsics
) -> Float64:
    """`observation_distance` (T,) between T + 1 consecutive frames.

    ``poses`` (T + 1, 4, 4) are the true ones.
    """
    found: list[float] = []
    before: RGBDFrame | None = None
    for k, frame in enumerate(frames):
        if before is not None:
            motion = invert(poses[k - 1]) @ poses[k]
            found.append(observation_distance(before, frame, motion, intrinsics))
        before = frame
    return np.array(found)


def sequence_divergence(
    sequence: RGBDSequence,
    config: DivergenceConfig | None = None,
    every: int = 1,
    measure: str | None = None,
) -> SequenceDivergence:
    """Divergence of every frame from the one before, using every ``every``-th frame.

    ``measure``, one of ``ALL_MEASURES``, is that of the configuration by default.

    Raises:
        InputError: fewer than two frames are left, none has a depth reading, or an image cannot
            be read; an unknown measure; ``wasserstein`` if a true pose is unknown.
    """
    if measure is not None and measure not in ALL_MEASURES:
        raise unknown("measure", measure, ALL_MEASURES)
    if measure == WASSERSTEIN and not sequence.known.all():
        raise InputError(
            f"sequence {sequence.name}: the measure {WASSERSTEIN} needs the true pose of every "
            f"frame, and {int((~sequence.known).sum())} of {len(sequence)} have none"
        )
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise InputError(f"every must be an integer >= 1, got {every!r}")
    picked = range(0, len(sequence), every)
    if len(picked) < 2:
        raise InputError(
            f"sequence {sequence.name}: {len(sequence)} frames, every {every}th: "
            "a divergence needs two"
        )
    frames = (sequence.frames[k] for k in Bar(picked, desc=sequence.name, unit="frame"))
    config, K = config or DivergenceConfig(), sequence.intrinsics
    sequence.check_depth()
    if measure == WASSERSTEIN:
        values = consecutive_distances(frames, sequence.poses[list(picked)], K)[:, None]
    else:
        config = config if measure is None else replace(config, measure=measure)
        values = consecutive_divergences(frames, K, [config])[:, 0]
        if not sequence.has_color:
            values[:, 0] = np.nan
    times = sequence.timestamps[list(picked)]
    later = np.arange(len(sequence))[::every][1:]
    recording = sequence.frames
    files = [
        recording.entries[k].depth.name if isinstance(recording, Recording) else "" for k in later
    ]
    return SequenceDivergence(
        sequence.name,
        times[1:] - times[0],
        values,
        np.diff(times),
        later,
        files,
        measure or config.measure,
    )


# -- Results -----------------------------------------------------------------------------------


def as_metrics(measured: Sequence[SequenceDivergence]) -> list[dict[str, Any]]:
    """Statistics and values of all sequences, by registry key."""
    return [
        {
            "sequence": sequence.name,
            "frames": len(sequence.times) + 1,
            "statistics": _lines(sequence),
            "since_start_s": sequence.times.tolist(),
            **{f"{kind}_{sequence.word}": sequence.divergences[:, k].tolist()
               for k, kind in enumerate(sequence.kinds)},
        }
        for sequence in measured
    ]  # fmt: skip


def table(measured: Sequence[SequenceDivergence]) -> Table:
    """One line per sequence and kind: the statistics of Table I, per frame and per second."""
    lines = [
        {"sequence": sequence.name, **line, "frames": len(sequence.times) + 1}
        for sequence in measured
        for line in _lines(sequence)
    ]
    keys = [key for key in lines[0] if key not in ("sequence", "divergence", "frames")]
    return make_table(("sequence", "divergence", *keys, "frames"), lines)


def worst_table(measured: Sequence[SequenceDivergence]) -> Table:
    """The frames with the largest divergence from the one before, by sequence and kind."""
    lines: list[dict[str, Value]] = [
        {
            "sequence": sequence.name,
            "divergence": kind,
            "frame": int(sequence.frames[k]),
            "since_start_s": float(sequence.times[k]),
            ("distance" if sequence.units else "change"): float(sequence.divergences[k, column]),
            "frame_file": sequence.files[k],
        }
        for sequence in measured
        for column, kind in enumerate(sequence.kinds)
        for k in _worst(sequence.divergences[:, column])
    ]
    value = "distance" if measured[0].units else "change"
    columns = ("sequence", "divergence", "frame", "since_start_s", value, "frame_file")
    return make_table(columns, lines, "Hardest frames")


def _worst(values: Float64) -> list[int]:
    """Indices of the largest values (T,), largest first, without NaN."""
    order = np.argsort(-values, stable=True)[:_WORST]
    return [int(k) for k in order if not np.isnan(values[k])]


def chart(measured: Sequence[SequenceDivergence]) -> Chart:
    """The divergences over time, a line per sequence; without colour, none of intensity."""
    panels = []
    for k, kind in enumerate(measured[0].kinds):
        series = []
        for sequence in measured:
            values = sequence.divergences[:, k]
            if not np.isnan(values).all():
                picked = thinned(len(values))
                series.append(Series(sequence.name, sequence.times[picked].tolist(),
                                     values[picked].tolist(), mode="lines"))  # fmt: skip
        if series:
            panels.append(Panel("since_start_s", f"{kind}_{measured[0].word}", series))
    return Chart("divergence", "Divergence over time", "From frame to frame.", panels)


def _lines(sequence: SequenceDivergence) -> list[dict[str, Any]]:
    """The statistics of each kind, by registry key."""
    return [
        {
            "divergence": kind,
            **({"distance_unit": sequence.units[kind]} if sequence.units else {}),
            **{f"{sequence.word}_{name}": value for name, value in numbers.items()},
        }
        for kind, numbers in sequence.statistics().items()
    ]


def write_divergences(
    measured: Sequence[SequenceDivergence], settings: Mapping[str, Any], out: Path
) -> Results:
    """Write ``divergence.json``, ``table.md`` and ``divergence.png`` into folder ``out``."""
    return write_result_folder(
        out,
        "divergence.json",
        kind="divergence",
        title="How hard sequences are",
        about=_ABOUT,
        tables=[table(measured), worst_table(measured)],
        charts=[chart(measured)],
        content=settings,
        metrics={"sequences": as_metrics(measured)},
    )
