"""Why frames of a run were refused: reasons, alignment over time, and the first refused frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.evaluation.run_sequence import SequenceRun, Step
from ms_slam_env.evaluation.trajectory_charts import marked_panel
from ms_slam_env.report import figures
from ms_slam_env.report.charts import Chart
from ms_slam_env.report.tables import Table, make_table
from ms_slam_env.slam.slam_backend import TrackResult, Views

REFUSED = "refused.png"
ALIGNMENT = ("inlier_fraction", "overlap", "residual_m", "degenerate_directions")
"""Fields of a ``TrackResult`` about a frame's alignment, which are also registry keys."""


@dataclass(frozen=True)
class LostReason:
    """Frames that were lost for the same reason.

    Attributes:
        reason: in words.
        frames: their numbers, increasing.
        inlier_fraction: median over these frames.
        overlap: median over these frames.
    """

    reason: str
    frames: tuple[int, ...]
    inlier_fraction: float
    overlap: float

    def __str__(self) -> str:
        """One line for a terminal."""
        count = len(self.frames)
        return (
            f"{count} frame{'s' * (count > 1)}, the first {self.frames[0]}: {self.reason} "
            f"(median overlap {self.overlap:.0%}, inliers {self.inlier_fraction:.0%})"
        )


def lost_reasons(run: SequenceRun) -> list[LostReason]:
    """Why frames were lost, most frequent reason first; a dropped frame repeats the last reason."""
    frames: dict[str, list[int]] = {}
    for index, result in enumerate(run.results):
        if not result.tracking_ok and result.processed:
            frames.setdefault(result.reason or "not said", []).append(index)
    return [
        LostReason(reason, tuple(lost), *(_median(run, lost, key) for key in ALIGNMENT[:2]))
        for reason, lost in sorted(frames.items(), key=lambda item: -len(item[1]))
    ]


def _median(run: SequenceRun, frames: list[int], key: str) -> float:
    return float(np.median([getattr(run.results[frame], key) for frame in frames]))


def lost_table(reasons: list[LostReason]) -> Table:
    """Table with a row for each reason."""
    keys = ("lost_reason", "lost_frames", "first_lost_frame", "inlier_fraction", "overlap")
    rows: list[dict[str, str | float]] = [
        {
            "lost_reason": one.reason,
            "lost_frames": len(one.frames),
            "first_lost_frame": one.frames[0],
            "inlier_fraction": one.inlier_fraction,
            "overlap": one.overlap,
        }
        for one in reasons
    ]
    note = "Inliers and overlap: medians over the frames that were refused for the reason."
    return make_table(keys, rows, "Why frames were lost", note)


def alignment_columns(run: SequenceRun) -> dict[str, Float64]:
    """Quality of the alignment of each frame (N,), by key."""
    return {
        key: np.array([getattr(result, key) for result in run.results], dtype=np.float64)
        for key in ALIGNMENT
    }


def alignment_chart(run: SequenceRun) -> Chart:
    """Quality of the alignment over the frames; lost ones are marked."""
    lost = np.flatnonzero(~run.tracking_ok)
    panels = [marked_panel(key, values, lost) for key, values in alignment_columns(run).items()]
    caption = "What each frame's alignment with the map explained; lost frames are marked."
    return Chart("alignment", "Alignment of every frame", caption, panels)


class RefusedFrame:
    """Keeps the first refused frame, and the view of the map from the pose held at that time.

    Args:
        has_map: whether a map exists before the first frame.
    """

    def __init__(self, has_map: bool) -> None:
        self._has_map = has_map
        self._found: tuple[Step, Views] | None = None

    def look(self, run: SequenceRun, step: Step) -> None:
        """Check the frame just processed, and keep it if it is the first refused one."""
        result = step.result
        if result.tracking_ok:
            self._has_map = True
        elif self._has_map and self._found is None:
            self._found = step, run.backend.predict(result.T_world_camera[None])

    def save(self, path: Path) -> None:
        """Draw colour and depth of frame and view; write no file if no frame was refused."""
        if self._found is None:
            return
        step, views = self._found
        figure = figures.new_figure(4, 3.0, 2.9)
        axes = figure.subplots(1, 4)
        deepest = max(float(step.frame.depth.max()), float(views.depth.max()), 1e-3)
        pictures = (
            ("frame", step.frame.color, None),
            ("the map's view", views.intensity[0], 255.0),
            ("depth of the frame", _depth(step.frame), deepest),
            ("depth of the view", np.where(views.depth[0] > 0, views.depth[0], np.nan), deepest),
        )
        for ax, (title, picture, most) in zip(axes, pictures, strict=True):
            is_depth = title.startswith("depth")
            shown = ax.imshow(picture, cmap="viridis" if is_depth else "gray", vmin=0, vmax=most)
            ax.set_title(title, fontsize="small")
            ax.set_axis_off()
        figure.colorbar(shown, ax=axes[2:], label="depth [m]", shrink=0.8)
        figures.caption(figure, _heading(step.index, step.result))
        figures.save(figure, path)


def _depth(frame: RGBDFrame) -> NDArray[np.floating]:
    return np.where(frame.depth > 0, frame.depth, np.nan)


def _heading(index: int, result: TrackResult) -> str:
    figures_of = f"overlap {result.overlap:.0%}, inliers {result.inlier_fraction:.0%}"
    residual = "" if math.isnan(result.residual_m) else f", {1e3 * result.residual_m:.1f} mm"
    refusal = f"{result.refusal}; " if result.refusal else ""
    return f"First refused frame, {index}: {result.reason} ({refusal}{figures_of}{residual})"
