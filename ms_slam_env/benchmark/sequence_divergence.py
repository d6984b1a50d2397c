"""How hard recorded sequences are: statistics of the divergence from frame to frame.

Saeedi et al., ICRA 2017, section V-C and Table I: "assigning statistics of the information
divergence, such as mean and variance, to the sequence"; "evaluated per unit of time".
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ms_slam_env.benchmark import figures
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.divergence import DivergenceConfig, make_divergence
from ms_slam_env.errors import InputError
from ms_slam_env.report.tables import format_number, markdown_table
from ms_slam_env.sequences import Sequence as RGBDSequence

Float64 = NDArray[np.float64]

KINDS = ("intensity", "depth")


@dataclass(frozen=True)
class SequenceDivergence:
    """Divergences of a sequence.

    Attributes:
        name: of the sequence.
        times: (T,) seconds of the later frame of each pair, from the first frame on.
        divergences: (T, 2) intensity, depth, nats; intensity is NaN where there is no colour.
        gaps_s: (T,) seconds between the two frames of each pair.
    """

    name: str
    times: Float64
    divergences: Float64
    gaps_s: Float64

    def statistics(self) -> dict[str, dict[str, float | None]]:
        """Of each kind: per frame ``max, mean, variance, std``; ``..._per_s`` those of the rates.

        A rate is a divergence over the time between its two frames, nats/s; mean and variance of
        the rates weigh each by that time, so that the mean is the sum of all divergences over the
        whole time. None without colour.
        """
        return {
            kind: statistics_of(self.divergences[:, column], self.gaps_s)
            for column, kind in enumerate(KINDS)
        }


def statistics_of(values: Float64, gaps_s: Float64) -> dict[str, float | None]:
    """Statistics of divergences (T,) between frames ``gaps_s`` (T,) apart, as described above."""
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
    """Divergences (T, C, 2) of each of T + 1 frames from the one before, with C configurations."""
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


def sequence_divergence(
    sequence: RGBDSequence, config: DivergenceConfig | None = None, every: int = 1
) -> SequenceDivergence:
    """Divergence of every frame from the one before, taking every ``every``-th frame.

    Raises:
        InputError: fewer than two frames are left, or an image cannot be read.
    """
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise InputError(f"every must be an integer >= 1, got {every!r}")
    picked = range(0, len(sequence), every)
    if len(picked) < 2:
        raise InputError(
            f"sequence {sequence.name}: {len(sequence)} frames, every {every}th: "
            "a divergence needs two"
        )
    frames = (sequence.frames[k] for k in tqdm(picked, desc=sequence.name, unit="frame"))
    config = config or DivergenceConfig()
    values = consecutive_divergences(frames, sequence.intrinsics, [config])[:, 0]
    if not sequence.has_color:
        values[:, 0] = np.nan
    times = sequence.timestamps[list(picked)]
    return SequenceDivergence(sequence.name, times[1:] - times[0], values, np.diff(times))


_SHOWN = {
    "max": "max",
    "mean": "mean",
    "variance": "variance",
    "std": "std",
    "max_per_s": "max / s",
    "mean_per_s": "mean / s",
    "variance_per_s": "variance / s²",
    "std_per_s": "std / s",
}


def table(measured: Sequence[SequenceDivergence]) -> str:
    """Markdown: one line a sequence and kind, Table I's statistics and those per second."""
    header = ["sequence", "divergence", *_SHOWN.values(), "frames"]
    body = []
    for sequence in measured:
        for kind, numbers in sequence.statistics().items():
            cells = (numbers[name] for name in _SHOWN)
            shown = ["-" if v is None else format_number(v, 3) for v in cells]
            body.append([sequence.name, kind, *shown, str(len(sequence.times) + 1)])
    return markdown_table(header, body)


def content(measured: Sequence[SequenceDivergence]) -> list[dict[str, Any]]:
    """Statistics and values of all sequences, for a JSON file."""
    return [
        {
            "sequence": sequence.name,
            "statistics": sequence.statistics(),
            "times_s": sequence.times.tolist(),
            **{kind: sequence.divergences[:, k].tolist() for k, kind in enumerate(KINDS)},
        }
        for sequence in measured
    ]


def save_figure(measured: Sequence[SequenceDivergence], path: Path) -> Path:
    """The divergences over time, a line for each sequence; none of intensity without colour."""
    known = [
        k for k in range(len(KINDS)) if any(~np.isnan(m.divergences[:, k]).all() for m in measured)
    ]
    figure = figures.new_figure(len(known), 4.6)
    axes = figure.subplots(1, len(known), squeeze=False)[0]
    for column, ax in zip(known, axes, strict=True):
        for index, sequence in enumerate(measured):
            ax.plot(
                sequence.times,
                sequence.divergences[:, column],
                color=figures.colour(index),
                linewidth=0.8,
                label=sequence.name,
            )
        ax.set(xlabel="time [s]", ylabel=f"{KINDS[column]} divergence [nats]")
        ax.grid(alpha=0.3)
    figures.legend_beside(figure, axes[0])
    return figures.save(figure, path)
