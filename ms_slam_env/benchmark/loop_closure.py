"""What loop closure does for trajectory and map, on rendered recordings that come back.

Each is run twice, with loop closure and without. Run as
``python -m ms_slam_env.benchmark.loop_closure --help``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.benchmark.loop_closure_run import NOISES, PATHS, LoopSpec, run_loop
from ms_slam_env.benchmark.planner_report import finished
from ms_slam_env.benchmark.runner import check_any_finished, failures, run_all
from ms_slam_env.benchmark.table import format_number, markdown_table
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.config import from_dict, nested_options
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import Row, write_json
from ms_slam_env.slam.surfel import SurfelConfig

PROGRAM = "python -m ms_slam_env.benchmark.loop_closure"
VARIANTS = ("none", "deformation")
DEFAULT_RECORDINGS = (
    "living_room:2000:around:0.02:1.5:kinect",
    "living_room:2001:around:0.02:1.5:kinect",
    "living_room:2002:around:0.06:5:kinect",
    "living_room:2003:around:0.06:5:kinect",
    "living_room:2000:around:0.02:1.5:coarse",
    "living_room:2001:around:0.02:1.5:coarse",
    "corridor:2000:corridor:0.04:3:kinect",
    "corridor:2001:corridor:0.04:3:kinect",
    "living_room:2004:handheld:0.04:2:kinect",
    "living_room:2005:handheld:0.04:2:kinect",
)
COLUMNS = (
    ("ate_m", "ATE [mm]", 1000),
    ("ate_aligned_m", "aligned [mm]", 1000),
    ("final_ate_m", "ATE, final poses [mm]", 1000),
    ("final_ate_aligned_m", "aligned [mm]", 1000),
    ("end_m", "end error [mm]", 1000),
    ("map_error_m", "map error [mm]", 1000),
    ("lost", "lost frames", 1),
    ("surfels", "surfels [1000]", 0.001),
    ("frame_ms", "ms/frame", 1),
    ("longest_ms", "longest [ms]", 1),
)


@dataclass(frozen=True)
class Arguments:
    """Recordings that come back to their start, with loop closure and without."""

    recordings: tuple[str, ...] = DEFAULT_RECORDINGS
    """scene:seed:path:step_m:step_deg:noise each; the scene may be a mesh file."""
    sizes: tuple[str, ...] = ("160x120", "320x240")
    """Image sizes."""
    options: tuple[str, ...] = ()
    """Parameters of the SLAM, as in loops.window=100."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/loop_closure")
    """Folder of the results; pictures of the maps go to its folder ``maps``."""

    def specs(self) -> list[LoopSpec]:
        """Every run."""
        options = nested_options(self.options)
        from_dict(SurfelConfig, options, "options")  # refuse bad ones before anything runs
        runs = []
        for size in self.sizes:
            for number, text in enumerate(self.recordings):
                for closure in VARIANTS:
                    picture = str(self.out / "maps" / f"{number:02d}_{size}.png")
                    shown = picture if closure != "none" else ""
                    runs.append(LoopSpec(*_parse(text), size, closure, options, shown))
        return runs


def _parse(text: str) -> tuple[str, int, str, float, float, str]:
    """Parts of a recording's name.

    Raises:
        InputError: another number of parts, no numbers, an unknown path or noise.
    """
    parts = text.rsplit(":", 5)
    if len(parts) != 6:
        raise InputError(f"recording {text!r} must be scene:seed:path:step_m:step_deg:noise")
    scene, seed, path, step_m, step_deg, noise = parts
    if path not in PATHS:
        raise unknown("path", path, PATHS)
    if noise not in NOISES:
        raise unknown("noise", noise, NOISES)
    try:
        return scene, int(seed), path, float(step_m), float(step_deg), noise
    except ValueError:
        raise InputError(f"recording {text!r}: seed and steps must be numbers") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    rows = run_all(args.specs(), run_loop, args.out, args.workers, "recordings")
    check_any_finished(rows)
    table = as_table(rows)
    content = {
        "provenance": provenance(),
        "config": asdict(args) | {"out": str(args.out)},
        "summary": summarise(rows),
        "runs": rows,
    }
    write_json(args.out / "loop_closure.json", content)
    (args.out / "table.md").write_text(table)
    print(table)
    return report_failures(failures(rows), PROGRAM)


def as_table(rows: Sequence[Row]) -> str:
    """Markdown: one line a run."""
    body = []
    for row in finished(rows):
        spec, result = LoopSpec(**row["spec"]), row["result"]
        found = [closure["before_m"] for closure in result["closures"]]
        left = [closure["after_m"] for closure in result["closures"]]
        gaps = "-"
        if found:
            gaps = " to ".join(format_number(1000 * float(np.median(x))) for x in (found, left))
        cells = [format_number(result[metric] * scale) for metric, _, scale in COLUMNS]
        count = f"{len(found)} ({result['wrong']})"
        body.append([f"{spec.name()}, {spec.size}", spec.closure, *cells, count, gaps])
    headings = [heading for _, heading, _ in COLUMNS]
    last = ["closures (wrong)", "gap [mm]"]
    return markdown_table(["recording", "loop closure", *headings, *last], body)


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Medians over the recordings that both variants finished, and how often closure was better."""
    results: dict[str, dict[str, dict[str, Any]]] = {}
    for row in finished(rows):
        spec = LoopSpec(**row["spec"])
        results.setdefault(f"{spec.name()}, {spec.size}", {})[spec.closure] = row["result"]
    pairs = [pair for pair in results.values() if len(pair) == len(VARIANTS)]
    summary: dict[str, Any] = {"recordings": len(pairs)}
    for metric, _, _ in COLUMNS:
        values = {name: [pair[name][metric] for pair in pairs] for name in VARIANTS}
        lower = np.less(values["deformation"], values["none"])
        summary[metric] = {
            "median": {name: float(np.median(x)) for name, x in values.items() if x},
            "lower_with_closure": int(lower.sum()),
        }
    return summary


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
