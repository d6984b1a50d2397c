"""The USME tables and the picture of the eight sequences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env import scenes
from ms_slam_env.benchmark import figures
from ms_slam_env.benchmark.usme_suite import SUITE, render
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import format_number, markdown_table

Column = tuple[str, str, float, int]
"""Name of the measure, heading, factor, significant digits."""

_TABLES: Mapping[str, tuple[Column, ...]] = {
    "Accuracy": (
        ("path_m", "path [m]", 1.0, 3),
        ("ate_m", "ATE [m]", 1.0, 3),
        ("ate_max_m", "largest [m]", 1.0, 3),
        ("ate_corrected_m", "ATE corrected [m]", 1.0, 3),
        ("end_error_m", "at the end [m]", 1.0, 3),
        ("drift", "of the path [%]", 100.0, 2),
        ("rpe_m", "RPE [mm]", 1e3, 3),
        ("rpe_rad", "RPE [deg]", 180 / np.pi, 2),
    ),
    "Map": (
        ("points", "points", 1.0, 7),
        ("c2c_mean_m", "C2C mean [m]", 1.0, 3),
        ("c2c_std_m", "C2C std [m]", 1.0, 3),
        ("hausdorff_m", "Hausdorff [m]", 1.0, 3),
        ("completion", "completion [%]", 100.0, 3),
        ("noise_ratio", "noise [%]", 100.0, 2),
        ("spacing_m", "spacing [mm]", 1e3, 3),
    ),
    "Robustness": (
        ("lost", "frames lost [%]", 100.0, 3),
        ("robustness", "robustness (10)", 1.0, 3),
        ("relocalisation_s", "relocalisation [s]", 1.0, 2),
        ("initialisation_s", "initialisation [s]", 1.0, 2),
        ("scale_error", "scale error [%]", 100.0, 2),
    ),
    "Cost": (
        ("frames", "frames", 1.0, 6),
        ("ext_ms", "EXT [ms]", 1.0, 3),
        ("ext_ms_p95", "95 % [ms]", 1.0, 3),
        ("cpu_ms_mean", "processor [ms]", 1.0, 3),
        ("mem_peak_mb", "MEM [MB]", 1.0, 3),
        ("ene_frame_j", "ENE [J a frame]", 1.0, 3),
    ),
}
_BORDER, _TITLE, _COLUMNS = 4, 20, 4
_FONT = cv2.FONT_HERSHEY_SIMPLEX

Image = NDArray[np.uint8]


def label(spec: Mapping[str, Any]) -> str:
    """Backend and its options as the user gave them."""
    return ",".join([spec["backend"], *(f"{k}={v}" for k, v in spec["params"].items())])


def tables(rows: Sequence[Row]) -> str:
    """The sequences that were run, then a table for each family; "-" where nothing applies."""
    parts = [_sequences(rows)]
    for title, columns in _TABLES.items():
        body = []
        for row in rows:
            cells = [_cell(row, *column) for column in columns]
            body.append([row["spec"]["sequence"], label(row["spec"]), *cells])
        header = ["sequence", "backend", *(heading for _, heading, _, _ in columns)]
        parts.append(f"### {title}\n\n{markdown_table(header, body)}")
    sources = {str(r["result"]["ene_source"]) for r in rows if r["error"] is None}
    parts += [f"- ENE: {source}" for source in sorted(sources)]
    failed = [row for row in rows if row["error"] is not None]
    parts += [f"- {label(r['spec'])} on {r['spec']['sequence']}: {r['error']}" for r in failed]
    return "\n".join(parts)


def _sequences(rows: Sequence[Row]) -> str:
    """What each sequence is: our Table 2, from the words of the paper."""
    names = {row["spec"]["sequence"] for row in rows}
    body = [
        [
            entry.name,
            entry.scene,
            "-" if entry.loops is None else str(entry.loops),
            ", ".join(text.replace(",", " ") for text in entry.perturbations) or "-",
            entry.about,
        ]
        for entry in SUITE
        if entry.name in names
    ]
    header = ["sequence", "scene", "loops", "perturbations", "what it is"]
    return f"### Sequences\n\n{markdown_table(header, body)}"


def save_figure(rows: Sequence[Row], path: Path) -> Path:
    """Error and share of lost frames of every backend on every sequence, side by side."""
    names = list(dict.fromkeys(row["spec"]["sequence"] for row in rows))
    backends = list(dict.fromkeys(label(row["spec"]) for row in rows))
    figure = figures.new_figure(2, 4.6, 0.7 + 0.42 * len(names))
    axes = figure.subplots(1, 2, sharey=True)
    height = 0.8 / len(backends)
    for index, backend in enumerate(backends):
        own = [r for r in rows if label(r["spec"]) == backend and r["error"] is None]
        at = [names.index(row["spec"]["sequence"]) + height * index for row in own]
        for ax, name, scale in zip(axes, ("ate_m", "lost"), (1.0, 100.0), strict=True):
            values = [scale * row["result"][name] for row in own]
            ax.barh(at, values, height, color=figures.colour(index), label=backend)
    axes[0].set(xscale="log", xlabel="ATE [m]")
    axes[1].set(xlabel="frames lost [%]", xlim=(0, 100))
    axes[0].set_yticks(np.arange(len(names)) + 0.4 - height / 2, names)
    axes[0].invert_yaxis()
    for ax in axes:
        ax.grid(alpha=0.3, axis="x")
    figures.plain_log_ticks(axes[0].xaxis)
    figures.legend_beside(figure, axes[0])
    return figures.save(figure, path)


def _cell(row: Row, name: str, _: str, scale: float, digits: int) -> str:
    if row["error"] is not None:
        return "failed"
    value = row["result"].get(name)
    if value is None:
        return "-"
    if isinstance(value, int):
        return str(value)
    if np.isinf(value):
        return "never"
    return format_number(value * scale, digits)


def contact_sheet(seed: int, image_size: str = "320x240") -> Image:
    """The eight sequences (BGR): two frames of each, one above the other."""
    made: dict[str, scenes.Scene] = {}
    tiles = []
    for entry in SUITE:
        if entry.scene not in made:
            made[entry.scene] = scenes.make(entry.scene, seed)
        sequence = render(entry, made[entry.scene], image_size)
        count = len(sequence)
        shown = [sequence.frames[k].color for k in (count // 3, int(0.52 * count))]
        tiles.append(_tile(entry.name, shown))
    rows = [np.concatenate(tiles[k : k + _COLUMNS], 1) for k in range(0, len(tiles), _COLUMNS)]
    return np.concatenate(rows, 0)


def save_contact_sheet(path: Path, seed: int) -> Path:
    """Write ``contact_sheet`` to ``path``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), contact_sheet(seed))
    return path


def _tile(name: str, images: Sequence[Image]) -> Image:
    h, w = images[0].shape[:2]
    tile = np.full((_TITLE + len(images) * (h + _BORDER), w + _BORDER, 3), 255, np.uint8)
    cv2.putText(tile, name, (4, 14), _FONT, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    for k, image in enumerate(images):
        top = _TITLE + k * (h + _BORDER)
        tile[top : top + h, :w] = image[:, :, ::-1]
    return tile
