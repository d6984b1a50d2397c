"""Does SLAM keep its pose, and recognise what moves, among moving boxes and people?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from ms_slam_env.report.tables import Table, finished, make_table, summary
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
        lines = _lines(rows)
        keys = [key for key in KEYS if any(key in line for line in lines)]
        medians = []
        for setting in (MOVING, STILL):
            for backend in dict.fromkeys(line["backend"] for line in lines):
                own = [x for x in lines if (x["setting"], x["backend"]) == (setting, backend)]
                if own:
                    cells = {key: summary(own, key) for key in keys if any(key in x for x in own)}
                    worst = max(line["ate_m"] for line in own)
                    medians.append(
                        {"setting": setting, "backend": backend, **cells, "worst_ate_m": worst}
                    )
        columns = ("setting", "backend", *keys[:2], "worst_ate_m", *keys[3:])
        note = "Medians over the sequences with 95 % intervals, and the largest ATE of one."
        return [
            make_table(columns, medians, note=note),
            make_table(("sequence", "backend", "moving_share", *keys), lines, "Every run"),
        ]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Error against processor time, a mark for each sequence with moving objects."""
        points = [
            cast(Row, {"spec": {"backend": line["backend"]}, "result": line, "error": None})
            for line in _lines(rows)
            if line["setting"] == MOVING
        ]
        panel = scatter(points, "cpu_ms_median", "ate_m", "backend", log="xy")
        caption = "One mark a sequence in which something moves."
        return [Chart("moving_objects", "Error against time", caption, [panel])]


def _rendered(spec: MovingObjectsSpec) -> sequences.RenderedSequence:
    path = sequences.HandheldPath(spec.frames)
    sequence = sequences.open_sequence(spec.sequence, spec.image_size, path=path, with_truth=True)
    return cast(sequences.RenderedSequence, sequence)


def _lines(rows: Sequence[Row]) -> list[Mapping[str, Any]]:
    """A line for each run."""
    return [
        {
            "sequence": row["spec"]["sequence"],
            "setting": MOVING if row["result"]["moving_share"] > 0 else STILL,
            "moving_share": row["result"]["moving_share"],
            **run,
        }
        for row in finished(rows)
        for run in row["result"]["runs"]
    ]


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
