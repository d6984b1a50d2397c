"""The learning curve of a training run as JSON, CSV and picture."""

from __future__ import annotations

import csv
import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure


def _write(path: Path, content: bytes) -> None:
    """Write a file so that an interrupt leaves the old content or the new, never half."""
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(content)
    os.replace(partial, path)


def write_curve(out: Path, curve: dict[str, Any]) -> None:
    """Write ``learning_curve`` as JSON (everything), CSV (the points) and PNG."""
    _write(out / "learning_curve.json", json.dumps(curve, indent=1).encode())
    table = io.StringIO()
    writer = csv.DictWriter(table, fieldnames=list(curve["points"][0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(curve["points"])
    _write(out / "learning_curve.csv", table.getvalue().encode())
    _write(out / "learning_curve.png", _draw(curve))


def _draw(curve: dict[str, Any]) -> bytes:
    """Draw validation return and mapped area over training, with the references as lines."""
    points = curve["points"]
    timesteps = [point["timesteps"] for point in points]
    figure = Figure(figsize=(10, 4), layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, name, label in (
        (axes[0], "return", "return of a validation episode"),
        (axes[1], "mapped_area_m2", "surface mapped in its place, m²"),
    ):
        axis.plot(timesteps, [point[name] for point in points], "o-", ms=3, label="policy")
        for i, (planner, result) in enumerate(curve["references"].items(), start=1):
            axis.axhline(result[name], color=f"C{i}", ls="--", label=planner)
        axis.set(xlabel="training steps", ylabel=label)
        axis.grid(alpha=0.3)
    mean = np.array([point["return"] for point in points])
    error = np.array([point["gain_sem"] for point in points])
    axes[0].fill_between(timesteps, mean - error, mean + error, alpha=0.2, lw=0)
    axes[0].legend(fontsize="small")
    figure.suptitle(
        f"mean of {curve['eval_episodes']} episodes; "
        "band: standard error of the paired difference to random walk"
    )
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    return picture.getvalue()
