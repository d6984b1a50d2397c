"""Picture of the map where a loop closed: before and after, from above."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.report.figures import caption, new_figure, save
from ms_slam_env.scenes import Scene
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam

BAND_M = (0.9, 1.5)  # heights shown: walls and furniture, neither floor nor ceiling
NEW_FRAMES = 40  # surfels younger than this are the present part
CELL_M = 0.2  # places compared for how much of both parts they show
ZOOM_M = 0.1  # half of what the lower row shows
_COLOURS = {"old": "#3366bb", "new": "#cc3311", "true": "#bbbbbb"}


@dataclass(frozen=True)
class MapView:
    """Points (N, 3) of a map and the age (N,) in frames of each."""

    points: Float64
    age: NDArray[np.int32]


def map_view(system: BatchedSurfelSlam, frame: int) -> MapView:
    """All points of a map as of a frame."""
    surfel_map = system.map
    points = surfel_map.points(stable=False)
    created = surfel_map.attribute("created", stable=False)
    return MapView(points, (frame - created).astype(np.int32))


def save_picture(
    views: tuple[MapView, MapView], scene: Scene, T_world_camera: Float64, path: Path, title: str
) -> Path:
    """Draw both maps within a band of heights; the lower row shows a part in view, enlarged."""
    surface = _band(scene.surface_points(0.01)[0])
    centre = _joined_part(views[0], T_world_camera)
    figure = new_figure(2, width=5.2, height=9.0)
    axes = figure.subplots(2, 2)
    for column, (view, name) in enumerate(zip(views, ("before", "after"), strict=True)):
        points, age = view.points, view.age
        inside = _in_band(points)
        points, age = points[inside], age[inside]
        for row, dot in enumerate((0.3, 4.0)):
            ax = axes[row, column]
            ax.scatter(surface[:, 0], surface[:, 1], s=dot, c=_COLOURS["true"], linewidths=0)
            for label, part in (("old", age > NEW_FRAMES), ("new", age <= NEW_FRAMES)):
                ax.scatter(*points[part, :2].T, s=dot, c=_COLOURS[label], linewidths=0)
            ax.set_aspect("equal")
            ax.set(xlabel="x [m]", ylabel="y [m]")
        axes[0, column].set_title(f"{name} the closure")
        axes[1, column].set_xlim(centre[0] - ZOOM_M, centre[0] + ZOOM_M)
        axes[1, column].set_ylim(centre[1] - ZOOM_M, centre[1] + ZOOM_M)
    caption(
        figure,
        f"{title}: surfels {BAND_M[0]} to {BAND_M[1]} m above the floor; blue: old, "
        f"red: of the last {NEW_FRAMES} frames, grey: true surface; below: enlarged",
    )
    return save(figure, path)


def _in_band(points: Float64) -> NDArray[np.bool_]:
    return (points[:, 2] > BAND_M[0]) & (points[:, 2] < BAND_M[1])


def _band(points: Float64) -> Float64:
    return points[_in_band(points)]


def _joined_part(view: MapView, pose: Float64) -> Float64:
    """Middle (2,) of the place, in view, with most old and new surfels together."""
    camera = (view.points - pose[:3, 3]) @ pose[:3, :3]
    u, v = camera[:, 0] / camera[:, 2], camera[:, 1] / camera[:, 2]
    seen = (camera[:, 2] > 0.3) & (np.abs(u) < 0.5) & (np.abs(v) < 0.4) & _in_band(view.points)
    places = view.points[seen, :2]
    names, index = np.unique(np.floor(places / CELL_M), axis=0, return_inverse=True)
    is_new = view.age[seen] <= NEW_FRAMES
    counts = [np.bincount(index.ravel()[part], minlength=len(names)) for part in (is_new, ~is_new)]
    return np.median(places[index.ravel() == np.minimum(*counts).argmax()], axis=0)
