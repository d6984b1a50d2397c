"""A comparison of two trajectories as text, table and figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.benchmark import figures
from ms_slam_env.benchmark.trajectory_evaluation import Matched, absolute
from ms_slam_env.report.tables import format_number, markdown_table

Float64 = NDArray[np.float64]

_STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
_ERRORS = (
    ("ate_m", "ATE [m]"),
    ("ate_rad", "ATE [rad]"),
    ("rpe_m", "RPE [m]"),
    ("rpe_rad", "RPE [rad]"),
)


def summary(result: dict[str, Any]) -> str:
    """Lines for a terminal."""
    unit = "" if result["delta_unit"] == "frames" else f" {result['delta_unit']}"
    lines = [
        f"{result['poses']} poses, alignment {result['align']}, delta {result['delta']}{unit}"
        + (f", scale {result['scale']:.6f}" if result["align"] == "sim3" else "")
    ]
    for name, unit in (("ate_m", "m"), ("ate_rad", "rad"), ("rpe_m", "m"), ("rpe_rad", "rad")):
        if result[name] is not None:
            values = "  ".join(f"{key} {value:.6f}" for key, value in result[name].items())
            lines.append(f"{name.split('_')[0].upper()} [{unit}]  {values}")
    robustness = result["robustness"]
    if robustness["gaps"]:
        lines.append(
            f"lost in {_gaps(robustness)}; robustness error "
            + (robustness["reason"] or f"{robustness['error']:.6f}")
        )
    return "\n".join(lines)


def tables(result: dict[str, Any]) -> str:
    """Everything that was measured, in Markdown."""
    unit = result["delta_unit"]
    parts = [
        f"{result['poses']} poses over {result['duration_s']:.3f} s and {result['path_m']:.3f} m, "
        f"timestamps at most {result['max_difference_s']:g} s apart ({result['unmatched_poses']} "
        "poses of the estimate have no true one); "
        f"alignment {result['align']} (scale {result['scale']:.6f}); relative errors over "
        f"{result['delta']} {unit} ({result['pairs']} pairs)."
    ]
    rows = [[heading, *_row(result[name])] for name, heading in _ERRORS]
    parts.append(markdown_table(["error", *_STATISTICS], rows))
    if len(result["segments"]) > 1:
        parts.append("RMSE of equal pieces:")
        rows = [
            [
                f"{piece['start_s']:.2f} to {piece['end_s']:.2f} s",
                str(piece["poses"]),
                *(_number(piece[name] and piece[name]["rmse"]) for name, _ in _ERRORS),
            ]
            for piece in result["segments"]
        ]
        parts.append(markdown_table(["piece", "poses", *(h for _, h in _ERRORS)], rows))
    if result["drift"]:
        parts.append("Drift over lengths of the true path:")
        rows = [
            [
                f"{drift['length_m']:.3f} m",
                str(drift["segments"]),
                *(_number(drift["translation_percent"][k]) for k in ("mean", "median", "max")),
                *(_number(drift["rotation_deg_m"][k]) for k in ("mean", "median", "max")),
            ]
            for drift in result["drift"]
        ]
        header = [f"{kind} {k}" for kind in ("[%]", "[deg/m]") for k in ("mean", "median", "max")]
        parts.append(markdown_table(["length", "segments", *header], rows))
    parts.append(_robustness(result))
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


def save_figure(matched: Matched, path: Path) -> Path:
    """Aligned trajectories from above and from the side; errors over time, gaps shaded."""
    figure = figures.new_figure(2, 4.4, 7.0)
    axes = figure.subplots(2, 2)
    for ax, (a, b) in zip(axes[0], ((0, 1), (0, 2)), strict=True):
        estimate = _broken(matched.estimate[:, :3, 3], matched.piece)
        ax.plot(*matched.true_path.T[[a, b]], ":", color="black", linewidth=1.0, label="truth")
        ax.plot(*estimate.T[[a, b]], color=figures.colour(0), linewidth=1.2, label="estimate")
        ax.set(xlabel=f"{'xyz'[a]} [m]", ylabel=f"{'xyz'[b]} [m]")
        ax.set_aspect("equal", adjustable="datalim")
        ax.grid(alpha=0.3)
    axes[0, 0].legend(fontsize="small")
    seconds = matched.times - matched.times[0]
    ate_m, ate_rad = absolute(matched)
    errors = [(1e3 * ate_m, "position error [mm]")]
    if ate_rad is not None:
        errors.append((np.degrees(ate_rad), "orientation error [deg]"))
    for ax, (values, label) in zip(axes[1], errors, strict=False):
        line = _broken(np.stack([seconds, values], axis=1), matched.piece)
        ax.plot(line[:, 0], line[:, 1], color=figures.colour(0), linewidth=1.0)
        for start, end in matched.gaps - matched.times[0]:
            ax.axvspan(start, end, color="grey", alpha=0.3, linewidth=0)
        ax.set(xlabel="time [s]", ylabel=label)
        ax.set_ylim(bottom=0)
        ax.grid(alpha=0.3)
    if ate_rad is None:
        axes[1, 1].set_axis_off()
    figures.caption(figure, "After alignment; x and y are the view from above.")
    path.parent.mkdir(parents=True, exist_ok=True)
    return figures.save(figure, path)


def _broken(line: Float64, piece: NDArray[np.int64]) -> Float64:
    """The points (N, k) of a line with NaN between pieces, so that no stroke joins them."""
    return np.insert(line, np.flatnonzero(np.diff(piece)) + 1, np.nan, axis=0)


def _robustness(result: dict[str, Any]) -> str:
    robustness, start = result["robustness"], result["initialisation"]
    lines = [f"- lost: {_gaps(robustness)}, {100 * robustness['lost_share']:.1f} % of the time"]
    if robustness["reason"]:
        lines.append(f"- robustness of tracking: not available: {robustness['reason']}")
    else:
        lines.append(
            f"- robustness of tracking over {robustness['pieces']} pieces (USME 10): "
            f"{_number(robustness['error'])} ({_number(robustness['translation_m'])} m, "
            f"{_number(robustness['rotation_rad'])} rad, log scale "
            f"{_number(robustness['log_scale'])})"
        )
    if start["time_s"] is None:
        lines.append("- initialisation: the scale does not settle")
    else:
        lines.append(
            f"- initialisation (USME 12, 13): {start['time_s']:.3f} s, scale {start['scale']:.4f}, "
            f"symmetric relative scale error {_number(start['scale_error'])}"
        )
    return "\n".join(lines)


def _gaps(robustness: dict[str, Any]) -> str:
    plural = "" if robustness["gaps"] == 1 else "s"
    return f"{robustness['gaps']} gap{plural}, {robustness['lost_s']:.3f} s together"


def _row(statistics: dict[str, float] | None) -> list[str]:
    if statistics is None:
        return ["-"] * len(_STATISTICS)
    return [_number(statistics[name]) for name in _STATISTICS]


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return "0" if abs(value) < 1e-12 else format_number(value, 4)
