"""Do measures of difficulty predict the error of SLAM? Rank correlations over all sequences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from ms_slam_experiments.difficulty import MOTIONS, watch_frames

from ms_slam_env import metrics, slam
from ms_slam_env._runtime.threads import limit_threads
from ms_slam_env.benchmark.compare import DEFAULT_SEQUENCES
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.config import Checked, bounded
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.run_sequence import run_backend
from ms_slam_env.evaluation.sequence_divergence import KINDS, WASSERSTEIN, consecutive_distances
from ms_slam_env.report.statistics import Interval, rank_correlation_interval
from ms_slam_env.report.tables import Row, Table, finished, flattened, make_table
from ms_slam_env.sequences import HandheldPath, open_sequence
from ms_slam_env.sequences import Sequence as RGBDSequence

HISTOGRAMS = {
    "kl, paper": DivergenceConfig.paper(),
    "kl": DivergenceConfig(),
    "windowed-kl": DivergenceConfig(measure="windowed-kl"),
    "earth-movers": DivergenceConfig(measure="earth-movers"),
}
ERRORS = {"ate_m": "correlation_ate", "rpe_m": "correlation_rpe", "lost_share": "correlation_lost"}
FAST = tuple(
    f"{scene}:{seed}:kinect+fast-motion,factor={factor},share=0.5"
    for scene, seed, factor in (("living_room", 2001, 3), ("table", 2001, 5), ("corridor", 2001, 4))
)


@dataclass(frozen=True)
class DifficultySpec:
    """Every backend on one sequence; see :class:`DifficultyErrors` for the fields."""

    sequence: str
    backends: tuple[str, ...]
    image_size: str
    frames: int


@dataclass(frozen=True)
class DifficultyErrors(Experiment, Checked):
    """Measures of difficulty beside the errors of SLAM

    The difficulty of a data set is the mean distance between consecutive frames: divergences of
    histograms (Saeedi et al., ICRA 2017, Table I), earth mover's distances, and the Wasserstein
    distance of the observations (Saeedi et al., ICRA 2019); the speed of the image is added. Each
    is compared with the errors of each backend by Spearman's correlation over sequences.
    """

    sequences: tuple[str, ...] = (*DEFAULT_SEQUENCES, *FAST)
    """Folders with true poses, or scene:seed[:word[+word ...]]."""
    backends: tuple[str, ...] = tuple(slam.BACKENDS)
    """NAME, parameters appended as in surfel,loop_closure=deformation."""
    image_size: str = "160x120"
    """Image size."""
    frames: int = bounded(150, 10, 100_000)
    """Number of frames of a rendered sequence."""

    unit = "sequences"

    def specs(self) -> list[DifficultySpec]:
        """Every sequence.

        Raises:
            InputError: fewer than three sequences.
        """
        if len(self.sequences) < 3:
            raise InputError("a correlation needs at least 3 sequences")
        return self.each(DifficultySpec, sequence=self.sequences)

    @staticmethod
    def run(spec: DifficultySpec) -> dict[str, Any]:
        """Measure the sequence and run every backend over it."""
        limit_threads(1)
        path = HandheldPath(spec.frames)
        opened = open_sequence(spec.sequence, spec.image_size, path=path, with_truth=True)
        opened = opened.where_known()
        watched = watch_frames(opened, HISTOGRAMS)
        distances = consecutive_distances(tuple(opened.frames), opened.poses, opened.intrinsics)
        values = {
            **{(name, kind): watched.divergences[name][:, k]
               for name in HISTOGRAMS for k, kind in enumerate(KINDS)},
            (WASSERSTEIN, "observation"): distances[~np.isnan(distances)],
            **{("motion", name): watched.motion[name] for name in MOTIONS},
        }  # fmt: skip
        return {
            "frames": len(opened),
            "measures": [
                {"measure": name, "divergence": kind, "difficulty": float(np.mean(of))}
                for (name, kind), of in values.items()
            ],
            "backends": [_errors(text, opened) for text in spec.backends],
        }

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Correlations of every measure with every backend's error, then the sequences."""
        count = len(finished(rows))
        note = f"Over {count} sequences, with 95 % intervals by resampling sequences."
        errors = flattened(rows, "backends")
        lines = [{"sequence": one["spec"]["sequence"], **one["result"]} for one in errors]
        columns = ("measure", "divergence", "backend", *ERRORS.values())
        return [
            make_table(columns, correlations(rows), note=note),
            make_table(("sequence", "backend", *ERRORS), lines, "Errors"),
            make_table(("sequence", "measure", "divergence", "difficulty"),
                       [{**one["spec"], **one["result"]} for one in flattened(rows, "measures")],
                       "Difficulty"),
        ]  # fmt: skip


def correlations(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Spearman's correlation, over sequences, of every measure with each error of each backend."""
    results = [row["result"] for row in finished(rows)]
    if not results:
        return []
    lines = []
    for m, of in enumerate(results[0]["measures"]):
        for b, backend in enumerate(results[0]["backends"]):
            found = {ERRORS[key]: _correlation(results, m, b, key) for key in ERRORS}
            labels = {key: of[key] for key in ("measure", "divergence")}
            lines.append({**labels, "backend": backend["backend"], **found})
    return lines


def _correlation(results: Sequence[Row], m: int, b: int, key: str) -> Interval:
    """Correlation of a measure and an error over sequences with both; NaN for fewer than three."""
    pairs = [(r["measures"][m]["difficulty"], r["backends"][b][key]) for r in results]
    known = [pair for pair in pairs if None not in pair and np.isfinite(pair).all()]
    pairs_known = zip(*known, strict=True) if len(known) > 2 else ((), ())
    return rank_correlation_interval(*map(list, pairs_known))


def _errors(backend: str, sequence: RGBDSequence) -> dict[str, Any]:
    """Errors of a backend that starts at the true pose."""
    run = run_backend(backend, sequence)
    return {
        "backend": backend,
        "ate_m": metrics.ate_rmse(run.estimates, run.true_poses),
        "rpe_m": metrics.rpe_rmse(run.estimates, run.true_poses),
        "lost_share": run.lost,
    }
