"""Does SLAM keep its pose, and recognise what moves, among moving boxes and people?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ms_slam_env import metrics, sequences, slam
from ms_slam_env._runtime.arrays import Bool
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.config import Checked, bounded, parse_named
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.report.charts import Chart, scatter
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import (
    Grouping,
    Table,
    finished,
    flattened,
    grouped,
    make_table,
    measured,
)
from ms_slam_env.slam.slam_backend import TrackResult

if TYPE_CHECKING:
    from ms_slam_env.sequences.rendering import RenderedFrames

_BOXES = "kinect+moving-objects,kind=box,count"
_PEOPLE = "kinect+moving-objects,kind=person,speed_m_s=1,count"
UNMASKED, MASKED = (f"surfel,motion_mask={mask}" for mask in ("none", "geometric"))
DEFAULT_SEQUENCES = (
    *(f"living_room:{2000 + k}:{_BOXES}={1 + k % 3}" for k in range(4)),
    *(f"living_room:{2006 + k}:{_PEOPLE}={1 + k % 2}" for k in range(4)),
    *(f"corridor:{2010 + k}:{_BOXES}={1 + k}" for k in range(3)),
    f"table:2013:{_BOXES}=2",
    *("living_room:2014", "corridor:2016", "table:2017", "carpet:2018"),
)
"""Rooms with moving boxes or people, and some in which nothing moves."""
KEYS = (
    *("lost_share", "ate_m", "ate_max_m", "ate_tracked_m", "tracked_share"),
    *("mask_precision", "mask_recall", "mask_iou", "mask_false_share", "cpu_ms_median"),
)
MOVING, STILL = "moving", "still"
_WARM_UP = 5  # frames left out of the timing


@dataclass(frozen=True)
class MovingObjectsSpec:
    """A sequence with its backends; see :class:`MovingObjectsExperiment` for the fields."""

    sequence: str
    backends: tuple[str, ...]
    image_size: str
    frames: int


@dataclass(frozen=True)
class MovingObjectsExperiment(Experiment, Checked):
    """Moving boxes and people: pose, and mask against the renderer's labels

    Every backend runs over the same frames from the true first pose. Masks are evaluated on the
    pixels with depth; a moving object also counts as moving while it stands still or turns on the
    spot.
    """

    sequences: tuple[str, ...] = DEFAULT_SEQUENCES
    """scene:seed[:word[+word ...]]."""
    backends: tuple[str, ...] = (UNMASKED, MASKED, "sparse", "volumetric")
    """NAME, parameters appended as in surfel,motion_mask=geometric."""
    image_size: str = "160x120"
    """Image size, such as 160x120."""
    frames: int = bounded(300, 10, 100_000)
    """Number of frames of a sequence."""

    unit = "sequences"
    workers = 1

    def __post_init__(self) -> None:
        """Refuse settings that no run could use."""
        super().__post_init__()
        for text in self.sequences:
            if Path(text).is_dir():
                raise InputError(f"{text}: a recording does not say what moves in it")

    def specs(self) -> list[MovingObjectsSpec]:
        """Every sequence."""
        return self.each(MovingObjectsSpec, sequence=self.sequences)

    @staticmethod
    def run(spec: MovingObjectsSpec) -> dict[str, Any]:
        """Run every backend over the frames, rendered once."""
        sequence = _rendered(spec)
        frames, true = list(sequence.frames), true_masks(sequence.frames)
        is_read = np.array([frame.depth > 0 for frame in frames])
        runs = []
        for text in spec.backends:
            name, params = parse_named(text, "backend")
            system = slam.make(name, sequence.intrinsics, **params)
            run = run_sequence(system, frames, start=sequence.poses[0])
            ate = metrics.ate_statistics(run.estimates, sequence.poses)
            found = found_masks(run.results, sequence.intrinsics.shape)
            runs.append(
                {
                    "backend": text,
                    "lost_share": run.lost,
                    "ate_m": ate.rmse,
                    **metrics.tracked_errors(run.estimates, sequence.poses, run.tracking_ok),
                    "ate_max_m": ate.max,
                    "cpu_ms_median": float(np.median(run.cpu_ms[_WARM_UP:])),
                    **({} if found is None else mask_measures(found, true, is_read)),
                }
            )
        share = float((true & is_read).sum() / is_read.sum())
        path_m = metrics.path_length(sequence.poses)
        return {"moving_share": share, "path_m": path_m, "runs": runs}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Medians with and without motion, then every run."""
        runs = _runs(rows)
        keys, by = measured(KEYS, runs), ("setting", "backend")
        in_order = sorted(runs, key=lambda run: str(run["spec"]["setting"]))
        medians = Grouping(by, keys).table(in_order).rows
        worst = [max(run["ate_m"] for run in own) for own in grouped(in_order, by).values()]
        lines = [{**line, "worst_ate_m": m} for line, m in zip(medians, worst, strict=True)]
        every = [{**run["spec"], **run["result"]} for run in runs]
        note = "Medians over the sequences with 95 % intervals, and the largest ATE of one."
        return [
            make_table((*by, *keys[:2], "worst_ate_m", *keys[3:]), lines, note=note),
            make_table(("sequence", "backend", "moving_share", *keys), every, "Every run"),
        ]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Error against processor time, a mark for each sequence with moving objects."""
        moving = [run for run in _runs(rows) if run["spec"]["setting"] == MOVING]
        panel = scatter(moving, "cpu_ms_median", "ate_m", "backend", log="xy")
        caption = "One mark a sequence in which something moves."
        return [Chart("moving_objects", "Error against time", caption, [panel])]


def _rendered(spec: MovingObjectsSpec) -> sequences.RenderedSequence:
    path = sequences.HandheldPath(spec.frames)
    sequence = sequences.open_sequence(spec.sequence, spec.image_size, path=path, with_truth=True)
    return cast(sequences.RenderedSequence, sequence)


def _runs(rows: Sequence[Row]) -> list[Row]:
    """A row for each run, which says whether something moves."""
    found: list[Row] = []
    for row in finished(rows):
        share = row["result"]["moving_share"]
        setting = {"setting": MOVING if share > 0 else STILL}
        for run in flattened([row], "runs"):
            result = {"moving_share": share, **run["result"]}
            found.append({**run, "spec": {**run["spec"], **setting}, "result": result})
    return found


def true_masks(frames: RenderedFrames) -> Bool:
    """Masks (N, H, W) of the moving objects in each frame, also while they stand still."""
    movers = tuple(frames.object_trajectories)
    moving = [
        index
        for index, label in enumerate(frames.labels)
        if any(label == name or label.startswith(f"{name} ") for name in movers)
    ]
    return np.array([np.isin(frames.truth(k).labels, moving) for k in range(len(frames))])


def found_masks(results: Sequence[TrackResult], shape: tuple[int, int]) -> Bool | None:
    """The masks (N, H, W) found by SLAM; None if it computes none, all False where it was lost."""
    known = [result.moving for result in results if result.moving is not None]
    if not known:
        return None
    nothing = np.zeros_like(known[0])
    step = -(-shape[0] // nothing.shape[0])
    rows, columns = (
        np.minimum((np.arange(size) + step // 2) // step, small - 1)
        for size, small in zip(shape, nothing.shape, strict=True)
    )
    masks = [nothing if result.moving is None else result.moving for result in results]
    return np.array(masks)[:, rows][:, :, columns]


def mask_measures(found: Bool, true: Bool, is_read: Bool) -> dict[str, float | None]:
    """Precision, recall, IoU and false share of masks (N, H, W), over the pixels with depth.

    Precision, recall and IoU are None if nothing moves.
    """
    found, true = found & is_read, true & is_read
    both, either = int((found & true).sum()), int((found | true).sum())
    moves = true.any()
    return {
        "mask_precision": both / int(found.sum()) if moves and found.any() else None,
        "mask_recall": both / int(true.sum()) if moves else None,
        "mask_iou": both / either if moves else None,
        "mask_false_share": int((found & ~true).sum()) / max(int(is_read.sum()), 1),
        "moving_share": int(true.sum()) / max(int(is_read.sum()), 1),
    }
