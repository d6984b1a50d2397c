"""How hard recorded sequences are: statistics of the divergence from frame to frame.

Saeedi et al., ICRA 2017, section V-C and Table I: "assigning statistics of the information
divergence, such as mean and variance, to the sequence"; "evaluated per unit of time".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ms_slam_env.benchmark import figures
from ms_slam_env.benchmark.table import format_number, markdown_table
from ms_slam_env.camera import intensity_image
from ms_slam_env.divergence import DivergenceConfig, make_divergence
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.recording import Recording

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
        """``max``, ``mean``, ``variance`` by kind, and ``mean_per_s``, ``max_per_s`` of the rates.

        The mean rate is the sum of all divergences over the whole time. None without colour.
        """
        found = {}
        for column, kind in enumerate(KINDS):
            values = self.divergences[:, column]
            rates = values / self.gaps_s
            numbers = {
                "max": values.max(),
                "mean": values.mean(),
                "variance": values.var(),
                "max_per_s": rates.max(),
                "mean_per_s": values.sum() / self.gaps_s.sum(),
            }
            found[kind] = {k: None if np.isnan(v) else float(v) for k, v in numbers.items()}
        return found


def sequence_divergence(
    recording: Recording, config: DivergenceConfig | None = None, every: int = 1
) -> SequenceDivergence:
    """Divergence of every frame from the one before, taking every ``every``-th frame.

    Raises:
        InputError: fewer than two frames are left, or an image cannot be read.
    """
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise InputError(f"every must be an integer >= 1, got {every!r}")
    picked = range(0, len(recording), every)
    if len(picked) < 2:
        raise InputError(
            f"sequence {recording.name}: {len(recording)} frames, every {every}th: "
            "a divergence needs two"
        )
    divergence = make_divergence(config or DivergenceConfig(), recording.intrinsics)
    previous = None
    rows = []
    for index in tqdm(picked, desc=recording.name, unit="frame"):
        frame = recording.frame(index)
        grey = intensity_image(frame.color).astype(np.float32)
        histograms = divergence.histograms(grey[None], frame.depth[None])
        if previous is not None:
            rows.append(divergence.divergence(histograms, previous)[0])
        previous = histograms
    values = np.array(rows)
    if not recording.has_color:
        values[:, 0] = np.nan
    times = recording.timestamps[list(picked)]
    return SequenceDivergence(recording.name, times[1:] - times[0], values, np.diff(times))


def table(measured: Sequence[SequenceDivergence]) -> str:
    """Markdown: one line a sequence and kind, Table I's statistics and those per second."""
    header = ["sequence", "divergence", "max", "mean", "variance", "max / s", "mean / s", "frames"]
    body = []
    for sequence in measured:
        for kind, numbers in sequence.statistics().items():
            shown = ["-" if v is None else format_number(v, 3) for v in numbers.values()]
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
