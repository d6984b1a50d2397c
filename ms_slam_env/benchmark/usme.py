"""SLAM backends on the eight sequences of the USME framework, with all of its metrics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from ms_slam_env import metrics, scenes, slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.threads import limit_threads, thread_environment
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import RGBDFrame, rendered_size, xtion
from ms_slam_env.config import Checked, bounded, parse_named
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.loop_closures import find_revisits, loop_measures
from ms_slam_env.evaluation.map_quality import ComparedMap
from ms_slam_env.evaluation.run_sequence import SequenceRun, run_sequence
from ms_slam_env.evaluation.seen_surface import surface_in_views
from ms_slam_env.evaluation.trajectory_charts import thinned
from ms_slam_env.geometry import transform_points
from ms_slam_env.geometry.point_clouds import ASKEW
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Table, finished, make_table, measured
from ms_slam_env.scenes import Scene
from ms_slam_env.sensor.noise import noise_config
from ms_slam_env.sequences.usme_suite import NAMES, SUITE, UsmeSequence, find, made_with, render

if TYPE_CHECKING:
    from ms_slam_env.sequences import RenderedSequence


TABLES: Mapping[str, tuple[str, ...]] = {
    "Accuracy": (
        *("path_m", "ate_m", "ate_tracked_m", "tracked_share", "ate_max_m", "final_ate_m"),
        *("end_error_m", "end_error_share", "rpe_m", "rpe_rad"),
    ),
    "Map": (
        *(
            "tracked_share",
            "map_points",
            "c2c_mean_m",
            "c2c_std_m",
            "hausdorff_directed_m",
            "recall_near",
        ),
        *("noise_ratio", "noise_beyond_m", "outlier_share", "spacing_m"),
    ),
    "Robustness": (
        *("lost_share", "tracked_pieces", "robustness", "relocalisation_s"),
        *("initialisation_s", "scale_error"),
    ),
    "Loops": (
        *("tracked_share", "revisits", "revisiting_frames", "stated_loops", "closed_loops"),
        *("loop_precision", "loop_recall"),
    ),
    "Cost": (
        *(
            "frames",
            "tracked_share",
            "ext_ms",
            "ext_ms_p95",
            "cpu_ms_mean",
            "mem_peak_mb",
            "ene_frame_j",
        ),
        *("ene_source", "ene_model_frame_j", "energy_source"),
    ),
}


_OPTIONS: Mapping[str, Any] = {"image_size": "160x120", "seed": 2000, "frames_scale": 1.0}
"""Default options for rendering a sequence that has no folder."""


@dataclass(frozen=True)
class Usme(Experiment, Checked):
    """SLAM backends over the eight sequences of the USME framework

    Four kinds of scenes (streets, factory hall, room), with and without loops, motion blur, moving
    objects, fast motion and black frames. Every run has a process of its own. Streets and hall take
    other parameters than a room, and where something moves surfel has ``motion_mask=geometric``.
    """

    folder: tyro.conf.Positional[Path | None] = None
    """Folder written by ms-slam usme make; without it frames are rendered on demand."""
    backends: tuple[str, ...] = (
        *("surfel", "surfel,loop_closure=deformation"),
        *("sparse", "volumetric", "kinectfusion", "odometry"),
    )
    """NAME, parameters appended as in surfel,loop_closure=deformation."""
    sequences: tuple[str, ...] = ()
    """Names of the sequences; by default those in the folder, or all."""
    image_size: str | None = None
    """Size of the images, such as 160x120; by default that of the folder, or 160x120."""
    seed: int | None = bounded(None, 0, 2**32 - 1)
    """Seed of scenes, paths, noise and perturbations; by default that of the folder, or 2000."""
    frames_scale: float | None = bounded(None, 0.002, 10.0)
    """Scale of the number of frames on the same paths: 0.5 halves the work and doubles the camera's
    speed; by default that of the folder, or 1."""

    workers = 1
    fresh_process = True
    tracks = True

    def __post_init__(self) -> None:
        """Refuse unknown sequences and image sizes."""
        super().__post_init__()
        check_suite(self.sequences or NAMES, self.image_size or _OPTIONS["image_size"])

    def environment(self) -> Mapping[str, str]:
        """Limit each run to one thread."""
        return thread_environment(1)

    def specs(self) -> list[UsmeSpec]:
        """List every run.

        Raises:
            InputError: an unknown backend or parameter, or a folder that lacks a sequence or was
                made with other options.
        """
        for text in self.backends:
            slam.check_parameters(*parse_named(text, "backend"))
        made = {name: self._options(name) for name in self._names()}
        return [
            UsmeSpec(sequence, backend, **options)
            for sequence, options in made.items()
            for backend in self.backends
        ]

    def _names(self) -> tuple[str, ...]:
        """Return the requested sequences, else those in the folder, else all."""
        if self.sequences or self.folder is None:
            return self.sequences or NAMES
        return tuple(name for name in NAMES if (self.folder / name).is_dir()) or NAMES

    def _options(self, name: str) -> dict[str, Any]:
        """Return the options that a sequence is made with; those of its folder if there is one."""
        folder = None if self.folder is None else self.folder / name
        made = _OPTIONS if folder is None else made_with(folder)
        for key, value in made.items():
            asked = getattr(self, key)
            if folder is not None and asked not in (None, value):
                words = key.replace("_", " ")
                raise InputError(f"{folder} was made with another {words}: {value}, not {asked}")
        asked_for = {key: getattr(self, key) for key in made if getattr(self, key) is not None}
        return {**made, **asked_for, "folder": None if folder is None else str(folder)}

    @staticmethod
    def run(spec: UsmeSpec) -> dict[str, Any]:
        """Track the sequence from its true first pose and measure."""
        limit_threads(1)
        return run_usme(spec)

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Tabulate the sequences that were run, then each family of metrics."""
        names = {row["spec"]["sequence"] for row in rows}
        entries = [
            {
                "sequence": entry.name,
                "scene": entry.scene,
                "loops": entry.loops,
                "perturbations": ", ".join(t.replace(",", " ") for t in entry.perturbations)
                or None,
                "about": entry.about,
            }
            for entry in SUITE
            if entry.name in names
        ]
        tables = [make_table(list(entries[0]), entries, "Sequences")]
        for title, family in TABLES.items():
            keys = measured(family, rows)
            lines = [
                {
                    **{name: row["spec"][name] for name in ("sequence", "backend")},
                    **{key: row["result"].get(key) for key in keys},
                }
                for row in finished(rows)
                if title != "Loops" or "loop_recall" in row["result"]
            ]
            tables.append(make_table(("sequence", "backend", *keys), lines, title))
        return tables

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Plot errors and losses of each backend on each sequence, and the paths with the truth."""
        return [_errors(rows), _paths(rows)]


def _errors(rows: Sequence[Row]) -> Chart:
    backends = dict.fromkeys(row["spec"]["backend"] for row in finished(rows))
    panels = []
    for key in ("ate_m", "lost_share"):
        series = []
        for backend in backends:
            own = [row for row in finished(rows) if row["spec"]["backend"] == backend]
            values = [row["result"][key] for row in own]
            names = [row["spec"]["sequence"] for row in own]
            series.append(Series(backend, values, names, mode="markers"))
        panels.append(Panel(key, "", series, "x" if key == "ate_m" else ""))
    return Chart("usme", "Error and losses", "One mark a run.", panels)


def _paths(rows: Sequence[Row]) -> Chart:
    """Plot every sequence from above, as in USME's figure 8."""
    panels = []
    for sequence in dict.fromkeys(row["spec"]["sequence"] for row in finished(rows)):
        own = [row for row in finished(rows) if row["spec"]["sequence"] == sequence]
        drawn = [(row["spec"]["backend"], row["result"], "path", "lines") for row in own]
        drawn.append(("truth", own[0]["result"], "true", "dashes"))
        lines = [
            Series(name, result[f"{path}_x_m"], result[f"{path}_y_m"], mode=mode)
            for name, result, path, mode in drawn
        ]
        panels.append(Panel("position_x_m", "position_y_m", lines, title=sequence, equal=True))
    return Chart("paths", "Paths", "From above; not aligned, all start at the truth.", panels)


def check_suite(sequences: Sequence[str], image_size: str) -> None:
    """Refuse unknown sequences and sizes.

    Raises:
        InputError: lists the valid choices.
    """
    if not sequences:
        raise InputError("Usme.sequences is empty")
    for name in sequences:
        find(name)
    rendered_size(image_size)


LARGE_OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "surfel": {
        "depth_cutoff_m": 10.0,
        "bilateral_sigma_m": 0.003,
        "fusion_distance_m": 0.01,
        "depth_noise_m": 0.001,
        "max_surfels": 2_000_000,
    },
    "odometry": {"depth_cutoff_m": 10.0, "max_surfels": 2_000_000},
    "volumetric": {"depth_cutoff_m": 10.0, "voxel_m": 0.06},
    "kinectfusion": {"depth_cutoff_m": 10.0, "volume_size_m": 20.0},
    "sparse": {"depth_cutoff_m": 10.0},
}
"""Options that a backend needs in a large scene, in addition to the user's.

The backends' defaults suit a Kinect in a room. Streets and halls need a farther cut-off, and the
surfel SLAM needs filter widths that fit the noise of the camera there: with its defaults it was
lost 66 frames into a city street (seed 1000, 160x120), with these never.
"""

_OF_MAPS = (
    *("c2c_mean_m", "c2c_std_m", "hausdorff_directed_m", "recall_near"),
    *("noise_ratio", "noise_beyond_m", "outlier_share", "spacing_m"),
)
_WARM_UP = 5  # frames left out of the timing: buffers grow, kernels are loaded
_LOOP_VIEW_SIZE = "80x60"  # of the true depth used to find revisited places
_PATH_POINTS = 200  # drawn per path
_VIEW_EVERY_M = 1.5  # along the true path, for the true surface
_VIEW_SIZE = "320x240"
_MOST_VIEWS = 150
_MOST_POINTS = 1_000_000


@dataclass(frozen=True)
class UsmeSpec:
    """One run of a backend on a sequence.

    Attributes:
        sequence: its name in the suite.
        backend: ``NAME`` or ``NAME,parameter=value,...``, added to the scene's options.
        image_size: such as 160x120.
        seed: seed of scene, path, noise and perturbations.
        frames_scale: scale of the number of frames on the same path.
        folder: folder of the rendered sequence; None renders the frames on demand.
    """

    sequence: str
    backend: str
    image_size: str = "160x120"
    seed: int = 2000
    frames_scale: float = 1.0
    folder: str | None = None


def run_usme(spec: UsmeSpec) -> dict[str, Any]:
    """Track a sequence from its true first pose and measure.

    Returns:
        metrics by key, None where a metric does not apply or cannot be computed. Accuracy: USME
        equations 1 to 5, the last pose's error relative to the path length (None if the last frame
        was lost: a pose held since the start would be right where a loop ends), the poses of the
        finished map. Map, after outlier removal (6) and ICP: distances, ``hausdorff_directed_m``
        (7, spurious points of the map), ``recall_near``, ``noise_ratio`` (8) of all points, also
        those that outlier removal drops. Robustness (9 to 11, infinite: never relocalised) and,
        for a backend that closes loops, all of ``loop_measures``.
        Initialisation (12, 13). Cost: all of ``CostMeter.summary``. Paths for plotting.
    """
    entry = find(spec.sequence)
    scene = scenes.make(entry.scene, spec.seed)
    sequence = render(entry, scene, spec.image_size, spec.frames_scale)
    name, params = parse_named(spec.backend, "backend")
    options = {**slam_options(entry, name), **params}
    costs = metrics.CostMeter(str(options.get("device", "cpu")))
    system = slam.make(name, sequence.intrinsics, **options)
    black: list[bool] = []
    run = run_sequence(
        system,
        _frames(sequence, spec.folder),
        start=sequence.poses[0],
        meter=costs,
        on_step=lambda step: black.append(not step.frame.color.any()),
    )
    poses, truth = run.estimates, sequence.poses
    tracked, seconds = run.tracking_ok, np.array(run.timestamps)
    ate = metrics.ate_statistics(poses, truth)
    start = metrics.initialisation(seconds, poses, truth, global_scale=1.0)
    end_error = float(np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3])) if tracked[-1] else None
    robustness = metrics.tracking_robustness(poses, truth, tracked)
    path = metrics.path_length(truth)
    surface = _seen_surface(scene, sequence.poses, options)
    sigma_m = noise_config(entry.noise).depth_sigma_m(_reach_m(options))
    loops: dict[str, Any] = {}
    if system.closes_loops:
        loops = _loop_measures(run, scene, truth, options)
    drawn = thinned(len(poses), _PATH_POINTS)
    return {
        "frames": len(poses),
        "duration_s": float(seconds[-1] - seconds[0]),
        "path_m": path,
        "ate_m": ate.rmse,
        **metrics.tracked_errors(poses, truth, tracked),
        "ate_max_m": ate.max,
        "end_error_m": end_error,
        "end_error_share": None if end_error is None else end_error / path,
        "rpe_m": metrics.rpe_rmse(poses, truth),
        "rpe_rad": metrics.rpe_rmse(poses, truth, kind="rotation"),
        "final_ate_m": _final_ate(run, truth),
        "lost_share": run.lost,
        "tracked_pieces": len(robustness.segments),
        "robustness": robustness.error,
        "relocalisation_s": metrics.mean_relocalisation_time(
            seconds, np.array(black), run.anchored
        ),
        "initialisation_s": start.time_s,
        "scale_error": start.scale_error,
        **costs.summary(skip=min(_WARM_UP, len(poses) - 1)),
        **map_measures(system.surface_points(), surface, entry.scene, sigma_m),
        **loops,
        **_positions("path", poses[drawn]),
        **_positions("true", truth[drawn]),
    }


def slam_options(sequence: UsmeSequence, backend: str) -> dict[str, Any]:
    """Return the options of ``backend``: those of large scenes, and a mask for moving objects."""
    is_large = sequence.scene in scenes.LARGE_SCENES
    options = dict(LARGE_OPTIONS.get(backend, {})) if is_large else {}
    if backend == "surfel" and any(t.startswith("moving-objects") for t in sequence.perturbations):
        options["motion_mask"] = "geometric"
    return options


def _positions(name: str, poses: Float64) -> dict[str, list[float]]:
    return {f"{name}_{axis}_m": np.round(poses[:, k, 3], 3).tolist() for k, axis in enumerate("xy")}


def _loop_measures(
    run: SequenceRun, scene: Scene, truth: Float64, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Measure precision and recall of a run's loops, by true views without moving objects."""
    from ms_slam_env.sensor import RGBDSensor

    sensor = RGBDSensor(scene, xtion(_LOOP_VIEW_SIZE), noise="none")
    depths = np.stack([sensor.ground_truth(pose).depth for pose in truth])
    seconds = np.array(run.timestamps)
    revisits = find_revisits(depths, sensor.intrinsics, truth, seconds, _reach_m(options))
    loops = {k: result.loop for k, result in enumerate(run.results) if result.loop is not None}
    return dict(loop_measures(loops, truth, revisits, 5 * voxel_m(scene.name)))


def _reach_m(options: Mapping[str, Any]) -> float:
    return float(options.get("depth_cutoff_m", 8.0))


def _frames(sequence: RenderedSequence, folder: str | None) -> Iterator[RGBDFrame]:
    """Yield the frames, from a folder if there is one.

    Raises:
        InputError: the folder holds a different number of frames than the sequence, or no frame
            with a depth reading.
    """
    from ms_slam_env.sequences.recording import open_recording, recorded_sequence

    if folder is None:
        yield from sequence.frames
        return
    recording = recorded_sequence(open_recording(Path(folder)))
    if len(recording) != len(sequence):
        raise InputError(
            f"{folder} holds {len(recording)} frames, but the sequence has {len(sequence)}"
        )
    recording.check_depth()
    yield from recording.frames


def _final_ate(run: SequenceRun, truth: Float64) -> float | None:
    corrected = run.corrected()
    return None if corrected is None else metrics.ate_rmse(corrected, truth)


def _seen_surface(scene: Scene, poses: Float64, options: Mapping[str, Any]) -> Float64:
    """Return the true surface (M, 3) seen within SLAM's depth range, without moving objects."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    walked = np.concatenate([[0.0], np.cumsum(steps)])
    count = int(min(_MOST_VIEWS, max(20, walked[-1] / _VIEW_EVERY_M)))
    picked = np.unique(np.searchsorted(walked, np.linspace(0.0, walked[-1], count)))
    return surface_in_views(
        scene, poses[picked], xtion(_VIEW_SIZE), _reach_m(options), voxel_m(scene.name)
    )


def voxel_m(scene: str) -> float:
    """Return the spacing of the true surface's points, and the voxel edge for downsampling maps."""
    return 0.05 if scene in scenes.LARGE_SCENES else 0.01


def map_measures(points: Float64, surface: Float64, scene: str, sigma_m: float) -> dict[str, Any]:
    """Measure the map (N, 3) against the true surface (M, 3); see `run_usme`.

    ``sigma_m`` is the sensor's depth noise at the end of SLAM's range: what lies farther from the
    surface than that explains (`noise_ratio`), no reading put there.
    """
    near = 5 * voxel_m(scene)
    result: dict[str, Any] = {"map_points": len(points), "near_m": near, **dict.fromkeys(_OF_MAPS)}
    cloud = metrics.voxel_downsample(points, voxel_m(scene), ASKEW) if len(points) else points
    if len(cloud) < 100:
        return result
    if len(cloud) > _MOST_POINTS:
        cloud = cloud[np.linspace(0, len(cloud) - 1, _MOST_POINTS).astype(np.int64)]
    inliers = metrics.statistical_inliers(cloud)
    found = metrics.register_clouds(cloud[inliers], surface, "icp", cutoff_m=10 * near)
    every = transform_points(found.T_target_source, cloud)
    placed = ComparedMap(every[inliers], surface, voxel_m=0)
    return {
        **result,
        **placed.measure(("c2c_mean_m", "c2c_std_m", "hausdorff_directed_m")),
        "recall_near": placed.recall(near),
        "noise_ratio": metrics.noise_ratio(every, placed.surface, sigma_m),
        "noise_beyond_m": metrics.noise_distance(placed.surface, sigma_m),
        "outlier_share": 1.0 - float(inliers.mean()),
        "spacing_m": metrics.point_spacing(cloud),
    }
