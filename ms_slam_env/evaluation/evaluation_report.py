"""``ms-slam evaluate``: compare trajectories and maps; write text, JSON, tables and figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.evaluation.map_files import MEASURES, MapOptions, evaluate_maps
from ms_slam_env.evaluation.map_quality import ComparedMap, share_keys
from ms_slam_env.evaluation.rerun_file import write_paths
from ms_slam_env.evaluation.trajectory_charts import error_panel, path_panel, widest_axes
from ms_slam_env.evaluation.trajectory_files import Matched, TrajectoryOptions, match_files
from ms_slam_env.evaluation.trajectory_measures import (
    absolute,
    absolute_key,
    measure_matched,
    statistic_keys,
)
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report import figures
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.results import write_result_folder
from ms_slam_env.report.table_files import write_tables
from ms_slam_env.report.tables import Column, Table, format_value, make_table
from ms_slam_env.sequences import write_trajectory

Found = Mapping[str, Any]

EVALUATION = "evaluation.json"
_ABOUT = (
    "Trajectories: absolute error (ATE) after alignment and relative error (RPE) of the motion "
    "between two poses. Maps: distances between points of the map and of the true surface."
)
_ROBUSTNESS = (
    *("gaps", "lost_s", "lost_time_share", "covered_share", "tracked_pieces", "robustness"),
    *("robustness_translation_m", "robustness_rotation_rad", "robustness_log_scale"),
    *("initialisation_s", "initialisation_scale", "scale_error"),
)
_PRINTED = ("ate_printed_m", "rpe_printed_m", "rpe_printed_median_m")
_STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
_MOST_COVERED = 0.99  # above this, the share of the truth's time is not worth a word
_SHOWN_M = 0.1  # largest threshold in the curves of precision and recall
_MAX_DOTS = 40_000


@dataclass(frozen=True)
class Evaluation:
    """A comparison with the truth.

    Attributes:
        found: metrics by key.
        config: the files and the options.
        summary: lines for a terminal.
        tables: tables of the metrics.
        charts: charts of the metrics.
        write: writes further files into a folder.
        record: writes a Rerun recording to a file.
    """

    found: Found
    config: Mapping[str, Any]
    summary: str
    tables: Sequence[Table]
    charts: Sequence[Chart]
    write: Callable[[Path], object]
    record: Callable[[Path], object] | None = None


RECORDING = "evaluation.rrd"


def write_evaluation(
    parts: Sequence[Evaluation], out: Path, formats: Sequence[str] = (), rerun: bool = False
) -> None:
    """Write ``evaluation.json``, ``table.md``, figures and files of all parts into ``out``.

    ``formats`` (see `table_files.FORMATS`) adds the tables in other file formats; ``rerun`` adds a
    Rerun recording.
    """

    def write_more(folder: Path) -> None:
        for part in parts:
            part.write(folder)
            if rerun and part.record is not None:
                part.record(folder / RECORDING)
        write_tables([table for part in parts for table in part.tables], folder, formats)

    write_result_folder(
        out,
        EVALUATION,
        write_more,
        kind="evaluation",
        title="Estimate against the truth",
        about=_ABOUT,
        tables=[table for part in parts for table in part.tables],
        charts=[chart for part in parts for chart in part.charts],
        content={"config": {key: value for part in parts for key, value in part.config.items()}},
        metrics={key: value for part in parts for key, value in part.found.items()},
    )


def _one_line(keys: Sequence[str], found: Found, title: str, note: str = "") -> Table:
    return make_table(keys, [{key: found[key] for key in keys}], title, note)


# -- Trajectories ------------------------------------------------------------------------------


def evaluate_trajectories(estimate: Path, truth: Path, options: TrajectoryOptions) -> Evaluation:
    """Compare two TUM files; errors are those of `match_files` and `measure_matched`."""
    matched = match_files(estimate, truth, options)
    found = measure_matched(matched, options)

    def write(out: Path) -> None:
        for name, poses in (("estimate", matched.estimate), ("truth", matched.truth)):
            # A distinct name, since ``out`` may be the folder of the compared files.
            write_trajectory(out / f"evaluation.{name}.txt", matched.times, poses)

    return Evaluation(
        found,
        {"estimate": str(estimate), "truth": str(truth), **asdict(options)},
        trajectory_summary(found, options),
        trajectory_tables(found, options),
        trajectory_charts(matched, options),
        write,
        lambda path: write_paths(path, {"estimate": matched}),
    )


def trajectory_summary(found: Found, options: TrajectoryOptions) -> str:
    """Lines for a terminal."""
    unit = "frame" if (options.delta, options.delta_unit) == (1, "frames") else options.delta_unit
    lines = [
        f"{_matched(found)}, alignment {_alignment(options)}, RPE over {options.delta} {unit}"
        + (f", scale {found['scale']:.6f}" if options.align == "sim3" else "")
    ]
    for key in _errors(options):
        if found[key] is not None:
            values = zip(_STATISTICS, statistic_keys(key), strict=True)
            shown = "  ".join(f"{name} {found[of]:.6f}" for name, of in values)
            lines.append(f"{key.split('_')[0].upper()} [{key.split('_')[-1]}]  {shown}")
    if found["tracked_share"] is not None:
        lines.append(_of_tracked(found, options))
    reason = found.get("robustness_reason")
    if found["gaps"] or reason:
        text = f"not available: {reason}" if reason else f"{found['robustness']:.6f}"
        lines.append(f"lost in {_gaps(found)}; robustness error {text}")
    return "\n".join(lines)


def trajectory_tables(found: Found, options: TrajectoryOptions) -> list[Table]:
    """Tables of all measures."""
    errors = _errors(options)
    note = (
        f"{_matched(found)}, over {found['duration_s']:.3f} s and "
        f"{found['path_m']:.3f} m, timestamps at most {options.max_difference_s:g} s apart; "
        f"alignment {_alignment(options)} (scale {found['scale']:.6f}); relative errors over "
        f"{options.delta} {options.delta_unit} ({options.pairs} pairs)."
    )
    if found["tracked_share"] is not None:
        note += f" {_of_tracked(found, options).capitalize()}."
    statistics = [
        {"statistic": name, **{key: found.get(statistic_keys(key)[k]) for key in errors}}
        for k, name in enumerate(_STATISTICS)
    ]
    tables = [make_table(("statistic", *errors), statistics, "Errors", note)]
    if len(found["pieces"]) > 1:
        piece_keys = ("start_s", "end_s", "poses", *errors)
        tables.append(make_table(piece_keys, found["pieces"], "RMSE of equal pieces"))
    if found["drift_by_length"]:
        drifts = [
            Column(of, heading=f"{metric(key).heading} ({name})")
            for key in ("drift_translation", "drift_rotation_deg_m")
            for name, of in zip(_STATISTICS, statistic_keys(key), strict=True)
            if name in ("mean", "median", "max")
        ]
        title = "Drift over lengths of the true path"
        keys: list[Column | str] = ["length_m", "sub_trajectories", *drifts]
        tables.append(make_table(keys, found["drift_by_length"], title))
    printed = (absolute_key(options, "m"), "ate_printed_m", "rpe_m", *_PRINTED[1:])
    note = "Beside ours; they depend on the origin. USME's equations 2 and 5 appear to be these."
    title = "Errors as Zhang and Scaramuzza define them"
    tables.append(_one_line(printed, found, title, note))
    shown = [key for key in _ROBUSTNESS if found.get(key) is not None]
    note = f"{_gaps(found)}."
    if found.get("robustness_reason"):
        note += f" Robustness of tracking is not available: {found['robustness_reason']}."
    if found["initialisation_s"] is None:
        note += " The scale does not settle."
    return [*tables, _one_line(shown, found, "Robustness and initialisation", note)]


def trajectory_charts(matched: Matched, options: TrajectoryOptions) -> list[Chart]:
    """Both paths, and the absolute errors over time."""
    ate_m, ate_rad = absolute(matched)
    paths = {
        "truth": matched.true_path,
        "estimate": _broken(matched.estimate[:, :3, 3], matched.piece),
    }
    panels = [path_panel(paths)]
    times = matched.times - matched.times[0]
    for key, errors in (("position_error_m", ate_m), ("orientation_error_rad", ate_rad)):
        if errors is not None:
            line = _broken(np.stack([times, errors], axis=1), matched.piece)
            panels.append(error_panel(key, line[:, 0], {"estimate": line[:, 1]}))
    caption = (
        f"After alignment ({_alignment(options)}); lines are broken where the estimate was lost."
    )
    return [Chart("trajectory", "Path and error", caption, panels)]


def _matched(found: Found) -> str:
    """Number of poses behind the errors, in words; their share of the time if they lack some."""
    text = f"{found['poses']} of {found['poses'] + found['unmatched_poses']} poses have a true one"
    covered = found["covered_share"]
    return (
        text if covered > _MOST_COVERED else f"{text} ({100 * covered:.0f} % of the truth's time)"
    )


def _errors(options: TrajectoryOptions) -> tuple[str, ...]:
    return (*(absolute_key(options, unit) for unit in ("m", "rad")), *("rpe_m", "rpe_rad"))


def _alignment(options: TrajectoryOptions) -> str:
    return options.align + (
        "" if options.align_first is None else f" by the first {options.align_first} poses"
    )


def _of_tracked(found: Found, options: TrajectoryOptions) -> str:
    """Share and error of the tracked frames, in words."""
    share = f"{found['tracked_share']:.1%} of the poses"
    if options.frames is not None:
        return f"of tracked frames alone: {share}"
    error = found["ate_tracked_m"]
    return f"tracked: {share}" + ("" if error is None else f", ATE of these {error:.6f} m")


def _broken(line: Float64, piece: NDArray[np.int64]) -> Float64:
    """Points (N, k) of a line, with NaN between pieces so that they are not connected."""
    return np.insert(line, np.flatnonzero(np.diff(piece)) + 1, np.nan, axis=0)


def _gaps(found: Found) -> str:
    plural = "" if found["gaps"] == 1 else "s"
    return f"{found['gaps']} gap{plural}, {found['lost_s']:.3f} s together"


# -- Maps --------------------------------------------------------------------------------------


def evaluate_map_files(estimate: Path, truth: Path, options: MapOptions) -> Evaluation:
    """Compare two maps; errors are those of `evaluate_maps`."""
    found, compared = evaluate_maps(estimate, truth, options)
    return Evaluation(
        found,
        {"map": str(estimate), "true_map": str(truth), **asdict(options)},
        map_summary(found, options),
        map_tables(found, options),
        map_charts(compared),
        lambda out: save_map_picture(compared, out / "map.png"),
    )


def map_summary(found: Found, options: MapOptions) -> str:
    """Lines for a terminal."""
    lines = [map_heading(found, options)]
    for key in _map_keys(options):
        lines.append(f"{metric(key).label:<32} {format_value(found[key], key)}")
    if found["registration_share"] == 0:
        lines.append("registration found no pairs: the map was judged where it lies")
    return "\n".join(lines)


def map_tables(found: Found, options: MapOptions) -> list[Table]:
    """Tables of shares by threshold, then of all distances."""
    shares = share_keys(options.thresholds_m)
    others = [key for key in _map_keys(options) if key not in shares]
    return [
        _one_line(shares, found, "Map", map_heading(found, options)),
        _one_line(others, found, "Distances of the map"),
    ]


def map_heading(found: Found, options: MapOptions) -> str:
    """Heading that says what was compared."""
    removed = ", outliers removed" if options.remove_outliers else ""
    return (
        f"{found['compared_points']} map points ({found['map_kind']}) against "
        f"{found['compared_true_points']} true points ({found['true_map_kind']}), one a voxel of "
        f"{1e3 * options.voxel_m:g} mm; registration {options.register}{removed}"
    )


def map_charts(compared: ComparedMap) -> list[Chart]:
    """Chart of the shares of points within a distance."""
    limits = np.linspace(0, _SHOWN_M, 101)
    series = [
        Series(name, limits.tolist(), _shares(distances, limits).tolist(), mode="lines")
        for name, distances in (("precision", compared.to_surface), ("recall", compared.to_map))
    ]
    caption = "Precision: of the map's points; recall: of the true surface's."
    panel = Panel("threshold_m", "share_within", series)
    return [Chart("map_shares", "Share of points within a distance", caption, [panel])]


def save_map_picture(compared: ComparedMap, path: Path) -> Path:
    """Draw the map, seen along its shortest axis and coloured by its error."""
    figure = figures.new_figure(1, 4.6, 4.2)
    ax = figure.subplots()
    errors_cm = 100 * compared.to_surface
    picked = np.unique(np.linspace(0, len(errors_cm) - 1, _MAX_DOTS).astype(int))
    order = picked[np.argsort(errors_cm[picked])]  # the largest errors are drawn on top
    a, b = widest_axes(compared.cloud)
    (unseen,) = {0, 1, 2} - {a, b}
    dots = ax.scatter(
        compared.cloud[order, a],
        compared.cloud[order, b],
        c=errors_cm[order],
        s=1,
        linewidths=0,
        vmin=0,
        vmax=min(100 * _SHOWN_M, max(float(errors_cm.max()), 1e-6)),
        cmap="viridis",
        rasterized=True,
    )
    figure.colorbar(dots, ax=ax, label="distance to the truth [cm]")
    ax.set(xlabel=f"{'xyz'[a]} [m]", ylabel=f"{'xyz'[b]} [m]")
    ax.set_aspect("equal", adjustable="datalim")
    figures.caption(figure, f"Map where it was judged, seen along {'xyz'[unseen]}.")
    return figures.save(figure, path)


def _map_keys(options: MapOptions) -> tuple[str, ...]:
    others = ("noise_ratio", "noise_beyond_m", "outlier_share", "spacing_m")
    return (*share_keys(options.thresholds_m), *MEASURES, *others)


def _shares(distances: Float64, limits: Float64) -> Float64:
    """Share (K,) of the distances below each limit (K,)."""
    return np.searchsorted(np.sort(distances), limits, "left") / len(distances)
