"""A comparison of two maps as text, table and figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.benchmark import figures
from ms_slam_env.evaluation.map_quality import ComparedMap
from ms_slam_env.report.tables import format_number, markdown_table

_FIXED = (
    ("accuracy_cm", "accuracy [cm]", 1.0),
    ("completion_cm", "completion [cm]", 1.0),
    ("completion_ratio", "completion ratio, 5 cm [%]", 100.0),
    ("rer_m", "RER [mm]", 1e3),
    ("rcm", "RCM, 5 cm [%]", 100.0),
    ("c2c_mean_m", "cloud to cloud, mean [mm]", 1e3),
    ("c2c_std_m", "cloud to cloud, std [mm]", 1e3),
    ("c2c_rms_m", "cloud to cloud, RMS [mm]", 1e3),
    ("hausdorff_directed_m", "Hausdorff, map to truth [mm]", 1e3),
    ("hausdorff_m", "Hausdorff, both ways [mm]", 1e3),
    ("noise_ratio", "noise ratio (USME 8) [%]", 100.0),
    ("spacing_m", "spacing of points [mm]", 1e3),
)
_SHOWN_CM = 10.0
_MAX_DOTS = 40_000


def measures(result: dict[str, Any]) -> list[tuple[str, str]]:
    """Heading and value of every measure."""
    rows = []
    for threshold in result["thresholds_m"]:
        name = f"{100 * threshold:g}cm"
        for kind, heading in (
            ("precision", "precision"),
            ("recall", "recall"),
            ("f_score", "F-score"),
        ):
            value = 100 * result[f"{kind}_{name}"]
            rows.append((f"{heading}, {100 * threshold:g} cm [%]", format_number(value, 4)))
    rows += [(text, format_number(scale * result[key], 4)) for key, text, scale in _FIXED]
    return rows


def summary(result: dict[str, Any]) -> str:
    """Lines for a terminal."""
    lines = [_heading(result)]
    lines += [f"{text:<32} {value}" for text, value in measures(result)]
    if result["registration_share"] == 0:
        lines.append("registration found no pairs: the map was judged where it lies")
    return "\n".join(lines)


def tables(result: dict[str, Any]) -> str:
    """The same in Markdown."""
    return f"{_heading(result)}\n\n{markdown_table(['measure', 'value'], measures(result))}"


def save_figure(compared: ComparedMap, path: Path) -> Path:
    """The map from above, coloured by its error; shares of points within a distance."""
    figure = figures.new_figure(2, 4.6, 4.2)
    top, curve = figure.subplots(1, 2)
    errors_cm = 100 * compared.to_surface
    picked = np.unique(np.linspace(0, len(errors_cm) - 1, _MAX_DOTS).astype(int))
    order = picked[np.argsort(errors_cm[picked])]  # the worst lie on top, so that they are seen
    dots = top.scatter(
        compared.cloud[order, 0],
        compared.cloud[order, 1],
        c=errors_cm[order],
        s=1,
        linewidths=0,
        vmin=0,
        vmax=min(_SHOWN_CM, max(float(errors_cm.max()), 1e-6)),
        cmap="viridis",
        rasterized=True,
    )
    figure.colorbar(dots, ax=top, label="distance to the truth [cm]")
    top.set(xlabel="x [m]", ylabel="y [m]")
    top.set_aspect("equal", adjustable="datalim")
    for index, (distances, label) in enumerate(
        ((compared.to_surface, "precision"), (compared.to_map, "recall"))
    ):
        limits = np.linspace(0, _SHOWN_CM, 201)
        curve.plot(limits, _shares(distances, limits), color=figures.colour(index), label=label)
    curve.set(xlabel="threshold [cm]", ylabel="share of points [%]", xlim=(0, _SHOWN_CM))
    curve.set_ylim(0, 101)
    curve.grid(alpha=0.3)
    curve.legend(fontsize="small")
    figures.caption(figure, "Map where it was judged, along z; share of points within a distance.")
    path.parent.mkdir(parents=True, exist_ok=True)
    return figures.save(figure, path)


def _shares(distances: NDArray[np.float64], limits_cm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Per cent (K,) of the distances below each limit (K,)."""
    found = np.searchsorted(np.sort(100 * distances), limits_cm, "left")
    return 100 * found / len(distances)


def _heading(result: dict[str, Any]) -> str:
    removed = ", outliers removed" if result["remove_outliers"] else ""
    return (
        f"{result['compared_points']} map points ({result['map_kind']}) against "
        f"{result['compared_true_points']} true points ({result['true_map_kind']}), one a voxel of "
        f"{1e3 * result['voxel_m']:g} mm; registration {result['register']}{removed}"
    )
