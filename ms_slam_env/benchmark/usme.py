"""SLAM backends on the eight sequences of the USME framework, with all of its metrics."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro
from numpy.typing import NDArray

from ms_slam_env import metrics, scenes, slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.output_files import write_text
from ms_slam_env._runtime.threads import limit_threads, thread_environment
from ms_slam_env.benchmark.command_runs import (
    check_command,
    command_of,
    is_command,
    name_of,
    run_command,
)
from ms_slam_env.benchmark.compare import placed_poses
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.benchmark.rows import digest
from ms_slam_env.camera import rendered_size, xtion
from ms_slam_env.config import Checked, bounded, parse_named
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.evaluation.loop_closures import find_revisits, loop_measures
from ms_slam_env.evaluation.map_quality import ComparedMap
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.evaluation.seen_surface import surface_in_views
from ms_slam_env.evaluation.trajectory_charts import thinned
from ms_slam_env.evaluation.trajectory_files import Matched, TrajectoryOptions, matched_frames
from ms_slam_env.evaluation.trajectory_measures import (
    measure_matched,
    relative_statistics,
    statistic_keys,
)
from ms_slam_env.geometry import transform_points
from ms_slam_env.geometry.point_clouds import ASKEW
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.metrics.reconstruction import SAMPLES
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.tables import (
    Row,
    Table,
    finished,
    grouped,
    make_table,
    measured,
    summary,
)
from ms_slam_env.scenes import Scene
from ms_slam_env.sensor.noise import noise_config
from ms_slam_env.sequences import Sequence as RGBDSequence
from ms_slam_env.sequences import write_trajectory
from ms_slam_env.sequences.usme_suite import NAMES, SUITE, UsmeSequence, find, made_with, render

if TYPE_CHECKING:
    from ms_slam_env.sequences import Perturbation, RenderedSequence
    from ms_slam_env.slam.slam_backend import Loop


SUMMARY = (
    *("run_succeeded", "tracked_share", "ate_m", "ate_rad", "rpe_m", "end_error_share"),
    *("c2c_mean_m", "recall_near", "noise_ratio", "robustness", "relocalisation_s"),
    *("ext_ms", "mem_peak_mb"),
)
"""Metrics of which the summary gives the median over the seeds."""

TABLES: Mapping[str, tuple[str, ...]] = {
    "Accuracy": (
        *("run_succeeded", "path_m", "tracked_share", "ate_m", "ate_mean_m", "ate_median_m"),
        *("ate_std_m", "ate_max_m", "ate_tracked_m", "final_ate_m", "ate_rad", "ate_max_rad"),
        *("end_error_m", "end_error_share", "ate_printed_m", "rpe_printed_m"),
    ),
    "Map": (
        *("tracked_share", "map_points", "c2c_mean_m", "c2c_std_m", "hausdorff_directed_m"),
        *("recall_near", "noise_ratio", "noise_beyond_m", "outlier_share", "spacing_m"),
    ),
    "Robustness": (
        *("lost_share", "gaps", "lost_s", "tracked_pieces", "robustness"),
        *("robustness_translation_m", "robustness_rotation_rad", "relocalisation_s"),
        *("initialisation_s", "scale_error"),
    ),
    "Loops": (
        *("tracked_share", "revisits", "revisiting_frames", "stated_loops", "closed_loops"),
        *("loop_precision", "loop_recall"),
    ),
    "Cost": (
        *("frames", "duration_s", "tracked_share", "ext_ms", "ext_ms_p95", "cpu_ms_mean"),
        *("mem_peak_mb", "ene_frame_j", "ene_source", "ene_model_frame_j", "energy_source"),
    ),
}
NOTES: Mapping[str, str] = {
    "Accuracy": "A run succeeds if it loses at most 5 % of the frames and its ATE is at most 1 % "
    "of the path. The end error is missing where the last frame was lost.",
    "Map": "Missing where a system gave no map.",
    "Robustness": "The robustness error is 0 if nothing was lost, and missing if a loss has no "
    "tracked piece before or after it, as when SLAM is lost for good.",
}
MOST_LOST, MOST_ERROR = 0.05, 0.01  # of a run that succeeds: shares of the frames, of the path
DELTAS: tuple[tuple[float, str], ...] = ((1, "frames"), (1, "s"), (1, "m"), (5, "m"))
"""Spacings of the pairs of poses that relative errors are computed for."""


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
    """NAME, parameters appended as in surfel,loop_closure=deformation. Any other system is
    "NAME=command:PROGRAM --in {sequence} --out {trajectory}", as in ms-slam compare."""
    trajectories: tuple[str, ...] = ()
    """Trajectories of external systems, as NAME=FILE or NAME=FOLDER: TUM files, camera to world,
    with {sequence} and {seed} in place of a sequence's name and seed. A folder holds {sequence}.txt
    or {sequence}/trajectory.txt, or both names with -{seed} behind the sequence."""
    maps: tuple[str, ...] = ()
    """Maps of these systems or of commands, as NAME=FILE or NAME=FOLDER, in the frame of the
    trajectory: PLY files and the like; a folder holds {sequence}.ply or {sequence}/map.ply."""
    sequences: tuple[str, ...] = ()
    """Names of the sequences; by default those in the folder, or all."""
    image_size: str | None = None
    """Size of the images, such as 160x120; by default that of the folder, or 160x120."""
    seed: int | None = bounded(None, 0, 2**32 - 1)
    """Seed of scenes, paths, noise and perturbations; by default that of the folder, or 2000."""
    seeds: int | None = bounded(None, 1, 1000)
    """Number of seeds, counted up from --seed; by default 5, or 1 with a folder, which has one."""
    command_timeout_s: float = bounded(3600.0, 0.1, 1e6)
    """Seconds after which a command is stopped."""
    keep: Path | None = None
    """Folder that gets BACKEND/SEQUENCE-SEED with trajectory, map (PLY) and picture of every run;
    by default runs in the folder of the results."""
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
        for text in self.backends:
            if is_command(text):
                check_command(text)
        if self.folder is not None and self.seeds not in (None, 1):
            raise InputError("Usme.seeds: a folder holds one seed; leave it out for several")
        names = [*map(name_of, self.backends), *map(_name, self.trajectories)]
        if len(set(names)) < len(names):
            raise InputError(f"backends and trajectories {', '.join(names)} must differ")
        own = [name_of(text) for text in self.backends if not is_command(text)]
        for name in map(_name, self.maps):
            if name not in names or name in own:
                valid = [one for one in names if one not in own]
                raise unknown("system of a map", name, valid or ["one of --trajectories"])

    def environment(self) -> Mapping[str, str]:
        """Limit each run to one thread."""
        return thread_environment(1)

    def placed(self, out: Path) -> Usme:
        """Keep trajectories and maps in ``out`` unless they go elsewhere."""
        return self if self.keep is not None else replace(self, keep=out / "runs")

    def specs(self) -> list[UsmeSpec]:
        """List every run.

        Raises:
            InputError: an unknown backend or parameter, a system without a single trajectory, or a
                folder that lacks a sequence or was made with other options.
        """
        for text in self.backends:
            if not is_command(text):
                slam.check_parameters(*parse_named(text, "backend"))
        made = {name: self._options(name) for name in self._names()}
        keep = None if self.keep is None else str(self.keep)
        found = []
        for name, options in made.items():
            for k in range(self.seeds or (1 if self.folder else _SEEDS)):
                seed = options["seed"] + k
                where = {**options, "seed": seed, "keep": keep}
                for text in self.backends:
                    command = command_of(text) if is_command(text) else ""
                    files = self._files(name_of(text), name, seed) if command else {}
                    files |= {"timeout_s": self.command_timeout_s} if command else {}
                    found.append(UsmeSpec(name, name_of(text), command=command, **files, **where))
                for text in self.trajectories:
                    files = self._files(_name(text), name, seed)
                    found.append(UsmeSpec(name, _name(text), **files, **where))
        self._refuse_missing(found)
        return found

    def _files(self, system: str, sequence: str, seed: int) -> dict[str, Any]:
        """Return the trajectory and the map of an external system, with a digest of both."""
        found = {
            kind: next((str(_file(text, kind, sequence, seed)) for text in texts
                        if _name(text) == system), "")
            for kind, texts in (("trajectory", self.trajectories), ("map", self.maps))
        }  # fmt: skip
        return {**found, "digest": "".join(digest(Path(file)) for file in found.values() if file)}

    def _refuse_missing(self, specs: Sequence[UsmeSpec]) -> None:
        for name in map(_name, self.trajectories):
            files = [Path(spec.trajectory) for spec in specs if spec.backend == name]
            if not any(file.is_file() for file in files):
                raise InputError(f"no trajectory of {name}: {', '.join(map(str, files[:8]))}")

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
        by: tuple[str, ...] = ("sequence", "backend")
        scored = [_scored(row) for row in finished(rows)]
        keys = measured(SUMMARY, scored)
        lines = [
            {
                **dict(zip(by, group, strict=True)),
                "runs_counted": len(results),
                "successes": sum(bool(one["run_succeeded"]) for one in results),
                **{key: summary(results, key) for key in keys if key != "run_succeeded"},
            }
            for group, results in grouped(scored, by).items()
        ]
        columns = [key for key in keys if key != "run_succeeded"]
        tables = [
            make_table((*by, "runs_counted", "successes", *columns), lines, "Summary", _SUMMARY),
            make_table(list(entries[0]), entries, "Sequences"),
        ]
        by = (*by, "seed")
        for title, family in TABLES.items():
            keys = measured(family, scored)
            lines = [
                {
                    **{name: row["spec"].get(name) for name in by},
                    **{key: row["result"].get(key) for key in keys},
                }
                for row in scored
                if title != "Loops" or "loop_recall" in row["result"]
            ]
            tables.append(make_table((*by, *keys), lines, title, NOTES.get(title, "")))
            if title == "Accuracy":
                tables.append(_relative(scored, by))
        return tables

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Plot errors and losses of each backend on each sequence, and the paths with the truth."""
        return [_errors(rows), _paths(rows)]


_SUMMARY = "Medians over the seeds with 95 % bootstrap intervals; of runs that have a value."
_SEEDS = 5


def _scored(row: Mapping[str, Any]) -> dict[str, Any]:
    """Add to a finished row whether the run succeeded."""
    result = row["result"]
    error = result["ate_m"] / result["path_m"] if result["path_m"] > 0 else np.inf
    succeeded = bool(result["lost_share"] <= MOST_LOST and error <= MOST_ERROR)
    return {**row, "result": {**result, "run_succeeded": succeeded}}


def _relative(rows: Sequence[Mapping[str, Any]], by: Sequence[str]) -> Table:
    """Tabulate relative errors over every spacing, all statistics of translation."""
    lines = [
        {**{name: row["spec"].get(name) for name in by}, **line}
        for row in rows
        for line in row["result"].get("by_delta", ())
    ]
    keys = [*statistic_keys("rpe_m"), *statistic_keys("rpe_rad")]
    keys = [key for key in keys if "_min_" not in key]
    return make_table((*by, "delta_text", "pose_pairs", *keys), lines, "Relative errors")


def _name(text: str) -> str:
    """Return NAME of ``NAME=PATH``, else the name of the file or folder.

    Raises:
        InputError: an empty name or path.
    """
    name, sign, path = text.partition("=")
    name, path = (name, path) if sign else (Path(text).stem, text)
    if not (name and path):
        raise InputError(f"{text!r} is not NAME=FILE or NAME=FOLDER")
    return name


def _file(text: str, kind: str, sequence: str, seed: int) -> Path:
    """Return the file of a sequence in ``NAME=PATH``: the first that exists, else the likeliest."""
    path = text.partition("=")[2] or text
    path = path.replace("{sequence}", sequence).replace("{seed}", str(seed))
    suffix, inside = _IN_FOLDER[kind]
    folder = Path(path)
    if not folder.is_dir():
        return folder
    names = (f"{sequence}-{seed}", sequence)
    candidates = [folder / inside, *(folder / name / inside for name in names)]
    candidates += [folder / f"{name}{suffix}" for name in names]
    return next((file for file in candidates if file.is_file()), candidates[-1])


TRAJECTORY, FRAMES, MAP = "trajectory.txt", "frames.csv", "map.ply"
"""Files of a run, as in `run_to_folder`, which would load what a typo need not wait for."""
_IN_FOLDER = {"trajectory": (".txt", TRAJECTORY), "map": (".ply", MAP)}
"""Kind of file to its suffix if it is named after the sequence, and its name in a folder."""


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
    """Plot every sequence from above, as in USME's Fig. 8."""
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
_MAX_DOTS = 60_000  # of a map's picture
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
        command: ``command:PROGRAM ...`` that is run instead of a backend.
        trajectory: TUM file that is evaluated instead of a backend.
        map: map file of a command or a trajectory.
        digest: digest of the content of these files.
        timeout_s: seconds after which a command is stopped.
        keep: folder that gets trajectory and map; None for none.
    """

    sequence: str
    backend: str
    image_size: str = "160x120"
    seed: int = 2000
    frames_scale: float = 1.0
    folder: str | None = None
    command: str = ""
    trajectory: str = ""
    map: str = ""
    digest: str = ""
    timeout_s: float = 3600.0
    keep: str | None = None


@dataclass(frozen=True)
class _Outcome:
    """What a system gave for N frames.

    Attributes:
        poses: (N, 4, 4) T_world_camera, held where a frame was lost.
        tracked: (N,) whether the frame was tracked.
        anchored: (N,) whether it was tracked in the first submap.
        points: (M, 3) map points in the world; None if it gave no map.
        attributes: of the points, for the PLY file.
        costs: measures of cost.
        corrected: (N, 4, 4) poses in the finished map; None if it corrects none.
        loops: loops by frame; None if it states none.
    """

    poses: Float64
    tracked: NDArray[np.bool_]
    anchored: NDArray[np.bool_]
    points: Float64 | None
    attributes: Mapping[str, NDArray[Any]]
    costs: Mapping[str, Any]
    corrected: Float64 | None = None
    loops: Mapping[int, Loop] | None = None


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
    is_own = not (spec.command or spec.trajectory)
    name, params = parse_named(spec.backend if is_own else "surfel", "backend")
    options = {**slam_options(entry, name), **params}
    run = partial(_run_backend, name=name, options=options) if is_own else _run_external
    found = run(spec, sequence)
    poses, truth, seconds = found.poses, sequence.poses, np.asarray(sequence.timestamps)
    matched = matched_frames(seconds, poses, truth, found.tracked)
    measures = measure_matched(matched, TrajectoryOptions())
    black = _black(entry.made_perturbations(spec.frames_scale), len(poses))
    end_error = None
    if found.tracked[-1]:
        end_error = float(np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3]))
    surface = _seen_surface(scene, truth, options)
    sigma_m = noise_config(entry.noise).depth_sigma_m(_reach_m(options))
    points = np.empty((0, 3)) if found.points is None else found.points
    loops: dict[str, Any] = {}
    if found.loops is not None:
        loops = _loop_measures(found.loops, scene, truth, seconds, options)
    if spec.keep is not None:
        _keep(spec, seconds, found)
    drawn = thinned(len(poses), _PATH_POINTS)
    return {
        "frames": len(poses),
        **{key: value for key, value in measures.items() if key != "pieces"},
        "by_delta": _relative_errors(matched),
        "end_error_m": end_error,
        "end_error_share": None if end_error is None else end_error / measures["path_m"],
        "final_ate_m": None if found.corrected is None else ate_rmse(found.corrected, truth),
        "lost_share": 1.0 - float(found.tracked.mean()),
        "relocalisation_s": metrics.mean_relocalisation_time(seconds, black, found.anchored),
        **found.costs,
        **map_measures(points, surface, entry.scene, sigma_m),
        **({"map_points": None} if found.points is None else {}),
        **loops,
        **_positions("path", poses[drawn]),
        **_positions("true", truth[drawn]),
    }


def _black(perturbations: Sequence[Perturbation], frames: int) -> NDArray[np.bool_]:
    """Return which of the frames are black, (N,)."""
    from ms_slam_env.sequences import BlackFrames

    found = [one for one in perturbations if isinstance(one, BlackFrames)]
    return np.array([any(one.is_black(k) for one in found) for k in range(frames)], dtype=bool)


def _run_backend(
    spec: UsmeSpec, sequence: RenderedSequence, name: str, options: Mapping[str, Any]
) -> _Outcome:
    costs = metrics.CostMeter(str(options.get("device", "cpu")))
    system = slam.make(name, sequence.intrinsics, **options)
    frames = _shown(sequence, spec.folder).frames
    run = run_sequence(system, frames, start=sequence.poses[0], meter=costs)
    return _Outcome(
        run.estimates,
        run.tracking_ok,
        run.anchored,
        system.surface_points(),
        system.map_attributes(),
        costs.summary(skip=min(_WARM_UP, len(run) - 1)),
        run.corrected(),
        {k: result.loop for k, result in enumerate(run.results) if result.loop is not None}
        if system.closes_loops
        else None,
    )


def _run_external(spec: UsmeSpec, sequence: RenderedSequence) -> _Outcome:
    """Run a command, or read a trajectory; its first pose is put on the true one."""
    from ms_slam_env.evaluation.map_files import read_surface

    costs: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="ms-slam-usme-") as folder:
        path = Path(spec.trajectory)
        if spec.command:
            path = Path(folder) / TRAJECTORY
            cost = run_command(spec.command, _shown(sequence, spec.folder), path, spec.timeout_s)
            costs["ext_ms"] = 1e3 * cost.ext_s / len(sequence)
            costs["cpu_ms_mean"] = 1e3 * cost.cpu_s / len(sequence)
        placed = placed_poses(path, sequence)
    points = None
    if spec.map:
        cloud = read_surface(Path(spec.map), SAMPLES).points
        points = transform_points(placed.T_world_own, cloud)
    return _Outcome(placed.poses, placed.tracked, placed.tracked, points, {}, costs)


def _relative_errors(matched: Matched) -> list[dict[str, Any]]:
    """Return statistics of the relative errors, a line for each of ``DELTAS`` that has pairs."""
    lines = []
    for delta, unit in DELTAS:
        options = TrajectoryOptions(delta=delta, delta_unit=unit)
        try:
            pairs = metrics.pose_pairs(matched.truth, options.delta, unit, matched.times)
        except InputError:
            continue  # the sequence is shorter
        errors = relative_statistics(matched, options)
        lines.append({"delta_text": f"{delta:g} {unit}", "pose_pairs": len(pairs), **errors})
    return lines


def _keep(spec: UsmeSpec, seconds: Float64, found: _Outcome) -> None:
    """Write trajectory, tracked frames, map and picture of a run."""
    from ms_slam_env.evaluation.run_files import write_ply

    name = re.sub(r"[^\w.,=-]+", "_", spec.backend)
    folder = Path(str(spec.keep)) / name / f"{spec.sequence}-{spec.seed}"
    folder.mkdir(parents=True, exist_ok=True)
    write_trajectory(folder / TRAJECTORY, seconds, found.poses)
    lines = [f"{t:.6f},{int(ok)}" for t, ok in zip(seconds, found.tracked, strict=True)]
    write_text(folder / FRAMES, "\n".join(["timestamp,tracking_ok", *lines, ""]))
    if found.points is not None and len(found.points):
        write_ply(folder / MAP, found.points, dict(found.attributes))
        draw_map(found, folder / "map.png")


def draw_map(found: _Outcome, path: Path) -> Path:
    """Draw a map from above in its colours, with the path, as in USME's Fig. 8."""
    from ms_slam_env.report import figures

    assert found.points is not None
    figure = figures.new_figure(1, 4.6, 4.2)
    ax = figure.subplots()
    picked = np.unique(np.linspace(0, len(found.points) - 1, _MAX_DOTS).astype(np.int64))
    picked = picked[np.argsort(found.points[picked, 2])]  # what is higher hides what is below
    colors = found.attributes.get("color")
    shade = "0.6" if colors is None else colors[picked] / 255.0
    x, y = found.points[picked, :2].T
    ax.scatter(x, y, c=shade, s=0.6, linewidths=0, rasterized=True)
    ax.plot(*found.poses[:, :2, 3].T, color="tab:red", linewidth=1)
    ax.set(xlabel="x [m]", ylabel="y [m]")
    ax.set_aspect("equal", adjustable="datalim")
    figures.caption(figure, "The map from above, the estimated path in red.")
    return figures.save(figure, path)


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
    loops: Mapping[int, Loop],
    scene: Scene,
    truth: Float64,
    seconds: Float64,
    options: Mapping[str, Any],
) -> dict[str, Any]:
    """Measure precision and recall of a run's loops, by true views without moving objects."""
    from ms_slam_env.sensor import RGBDSensor

    sensor = RGBDSensor(scene, xtion(_LOOP_VIEW_SIZE), noise="none")
    depths = np.stack([sensor.ground_truth(pose).depth for pose in truth])
    revisits = find_revisits(depths, sensor.intrinsics, truth, seconds, _reach_m(options))
    return dict(loop_measures(loops, truth, revisits, 5 * voxel_m(scene.name)))


def _reach_m(options: Mapping[str, Any]) -> float:
    return float(options.get("depth_cutoff_m", 8.0))


def _shown(sequence: RenderedSequence, folder: str | None) -> RGBDSequence:
    """Return the sequence, with the frames of a folder if there is one.

    Raises:
        InputError: the folder holds a different number of frames than the sequence, or no frame
            with a depth reading.
    """
    from ms_slam_env.sequences.recording import open_recording, recorded_sequence

    if folder is None:
        return sequence
    recording = recorded_sequence(open_recording(Path(folder)))
    if len(recording) != len(sequence):
        raise InputError(
            f"{folder} holds {len(recording)} frames, but the sequence has {len(sequence)}"
        )
    recording.check_depth()
    return recording


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
