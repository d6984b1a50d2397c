"""Checks whether two overlaid maps show the same place, by the frames they were built from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import Checked, bounded
from ms_slam_env.geometry import invert
from ms_slam_env.slam.shared.alignment_measures import measure_photometric_consistency
from ms_slam_env.slam.slam_backend import Views

_LOOKS_AT = 0.2  # share of a frame that must fit the other map for the frame to be compared
_FAR_M = 10.0
LEAST_OVERLAP = 0.05  # share of the pixels with a reading that must fit the other map
LEAST_CONSISTENT = 0.85  # share of those that fit among those that fit or contradict
LEAST_ALIKE = 0.5
"""Least correlation of the images' fine structure with the other map's view.

The median over the frames that overlap it.
"""


@dataclass(frozen=True)
class FitConfig(Checked):
    """Parameters of the check whether two maps show the same place.

    Attributes:
        queries: number of frames of each map compared with the other.
        tolerance_m: largest depth difference of a reading that fits the other map.
    """

    queries: int = bounded(24, 1, 10_000)
    tolerance_m: float = bounded(0.05, 1e-4, 1.0)


class MapRenderer(Protocol):
    """Renders a map."""

    def predict(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """Render the map from ``poses`` (N, 4, 4)."""


class SeenMap(Protocol):
    """A map, and the N frames it was built from."""

    @property
    def backend(self) -> MapRenderer:
        """The renderer of the map."""

    @property
    def frames(self) -> Sequence[RGBDFrame]:
        """The N frames."""

    @property
    def estimates(self) -> Float64:
        """Their estimated poses (N, 4, 4) T_map_camera."""

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """Which frames (N,) are part of the map."""


@dataclass(frozen=True)
class Fit:
    """How well each map's frames fit the other map."""

    overlap: float = float("nan")  # share of the pixels with a reading that fit
    consistent: float = float("nan")  # share of those among the pixels that fit or contradict
    # correlation with the other map's view, median over the frames that overlap it.
    alike: float = float("nan")


def why_not_believed(fit: Fit) -> str:
    """Why the fit does not show the same place; empty if it does."""
    if fit.overlap < LEAST_OVERLAP:
        return "the maps hardly overlap there"
    if fit.consistent < LEAST_CONSISTENT:
        return "the surfaces contradict each other there"
    if not fit.alike >= LEAST_ALIKE:
        return "the images do not look alike there"
    return ""


def measure_fit(a: SeenMap, b: SeenMap, T_a_b: Float64, config: FitConfig) -> Fit:
    """Compare the frames of each map with the view that the other predicts at their poses.

    A map surface behind a reading is no evidence: perhaps only the map's camera saw it. One in
    front of the reading contradicts it, because the ray passed through. Frames that do not overlap
    the other map are no evidence either.
    """
    fits, contradictions, readings = 0, 0, 0
    alike: list[float] = []
    for here, there, T_here_there in ((a, b, T_a_b), (b, a, invert(T_a_b))):
        indices = query_frames(there, config.queries)
        views = here.backend.predict(T_here_there @ there.estimates[indices])
        for grey, depth, index in zip(views.intensity, views.depth, indices, strict=True):
            frame = there.frames[index]
            valid = frame.depth > 0
            both = valid & (depth > 0)
            difference = depth - frame.depth
            here_fits = both & (np.abs(difference) <= config.tolerance_m)
            fits += int(here_fits.sum())
            contradictions += int((both & (difference < -config.tolerance_m)).sum())
            readings += int(valid.sum())
            if here_fits.sum() >= _LOOKS_AT * max(1, valid.sum()):
                same = np.where(here_fits, depth, np.float32(0))
                found = measure_photometric_consistency(
                    frame.color, frame.depth, grey, same, _FAR_M
                )
                alike.append(found.correlation)
    return Fit(
        overlap=fits / readings if readings else 0.0,
        consistent=fits / (fits + contradictions) if fits else 0.0,
        alike=float(np.median(alike)) if alike else float("nan"),
    )


def query_frames(seen: SeenMap, count: int) -> list[int]:
    """Indices of at most ``count`` tracked frames, evenly spread over the path."""
    tracked = np.flatnonzero(seen.tracked)
    if len(tracked) == 0:
        return []
    picked = np.linspace(0, len(tracked) - 1, min(count, len(tracked))).round().astype(int)
    return tracked[picked].tolist()
