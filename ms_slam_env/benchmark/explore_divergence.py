"""Error and time of one configuration at several divergences, as in Fig. 5 of the paper.

Every n-th frame of hand-held sequences is processed, which makes the divergence between processed
frames larger. Fig. 5 shows maximum ATE against EXT, Fig. 3 ATE against divergence. Run as
``python -m ms_slam_env.benchmark.explore_divergence --help``.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from tqdm import tqdm

from ms_slam_env.benchmark.explore_evaluation import SlamEvaluator
from ms_slam_env.benchmark.figures import new_figure, plain_log_ticks, save
from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.exploration.objectives import FAILURE
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.report.tables import format_number, markdown_table
from ms_slam_env.slam.configuration import SlamConfiguration, read_configuration

PROGRAM = "python -m ms_slam_env.benchmark.explore_divergence"
_FIGURES = ("M_I", "M_D", "ate_m", "ate_max_m", "ext_ms", "load_ms")


@dataclass(frozen=True)
class Arguments:
    """Error, time and divergence when every n-th frame is processed."""

    sequences: tuple[str, ...] = ("living_room:1000", "corridor:1001", "table:1002", "carpet:1003")
    """Folders, or scene:seed[:noise[+perturbation ...]]."""
    keep_every: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 10)
    """Every so many frames are processed."""
    config: Path | None = None
    """Configuration file (YAML); by default the surfel backend's own."""
    image_size: str = "160x120"
    """Of the camera."""
    frames: int = 90
    """Length of a whole rendered sequence."""
    out: Path = Path("results/explore_divergence")
    """Folder of the results."""


def run(arguments: Arguments) -> str:
    """Measure, write ``divergence.json``, ``table.md``, ``divergence.png``; return the table."""
    evaluator = SlamEvaluator(
        arguments.sequences, arguments.frames, image_size=arguments.image_size
    )
    base = SlamConfiguration()
    if arguments.config is not None:
        base = read_configuration(arguments.config)
    rows = []
    pairs = [(text, every) for text in arguments.sequences for every in arguments.keep_every]
    for text, every in tqdm(pairs, unit="run"):
        configuration = dataclasses.replace(base, keep_every=every)
        rows.append({"keep_every": every, **evaluator.measure(configuration, text)})
    content = {
        "provenance": provenance(),
        "config": {**asdict(evaluator), "base": asdict(base)},
        "summary": [summary(rows, every) for every in arguments.keep_every],
        "runs": rows,
    }
    write_json(arguments.out / "divergence.json", content)
    text = table(content["summary"])  # type: ignore[arg-type]
    (arguments.out / "table.md").write_text(text, encoding="utf-8")
    save(figure(rows), arguments.out / "divergence.png")
    return text


def summary(rows: Sequence[Mapping[str, Any]], every: int) -> dict[str, Any]:
    """Medians over the sequences at one rate, and how many failed."""
    own = [row for row in rows if row["keep_every"] == every]
    result: dict[str, Any] = {"keep_every": every, "sequences": len(own)}
    result["failed"] = sum(bool(row.get(FAILURE)) for row in own)
    for name in _FIGURES:
        known = [row[name] for row in own if row.get(name) is not None]
        result[name] = float(np.median(known)) if known else None
    return result


def table(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Markdown: one line a rate."""
    header = ["every n-th frame", *_FIGURES, "failed"]
    return markdown_table(
        header,
        [
            [
                str(row["keep_every"]),
                *("-" if row[n] is None else format_number(row[n], 3) for n in _FIGURES),
                f"{row['failed']} of {row['sequences']}",
            ]
            for row in summaries
        ],
    )


def figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Left Fig. 5, maximum ATE against EXT, coloured by divergence; right Fig. 3."""
    drawn = new_figure(columns=2, width=4.2)
    left, right = drawn.subplots(1, 2)
    rows = [row for row in rows if row.get("ate_m") is not None]
    divergence = np.array([row["M_I"] for row in rows])
    norm = LogNorm(divergence.min(), divergence.max())
    for failed, mark in ((False, "o"), (True, "x")):
        own = [k for k, row in enumerate(rows) if bool(row.get(FAILURE)) == failed]
        if not own:
            continue
        shown = left.scatter(
            [rows[k]["ext_ms"] for k in own],
            [rows[k]["ate_max_m"] for k in own],
            c=divergence[own],
            marker=mark,
            norm=norm,
            label="lost" if failed else "tracked",
        )
        right.scatter(divergence[own], [rows[k]["ate_m"] for k in own], marker=mark, color="C0")
    drawn.colorbar(shown, ax=left, label="M_I [nats]")
    left.set(xlabel="EXT [ms/frame]", ylabel="maximum ATE [m]", yscale="log")
    right.set(xlabel="M_I [nats]", ylabel="ATE [m]", xscale="log", yscale="log")
    left.legend(fontsize="small")
    for axis in (left.yaxis, right.xaxis, right.yaxis):
        plain_log_ticks(axis)
    return drawn


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print the table."""
    print(run(parse(Arguments, arguments, PROGRAM)))
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
