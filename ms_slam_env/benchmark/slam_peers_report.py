"""The comparison of SLAM systems as Markdown."""

from __future__ import annotations

from typing import Any

import numpy as np

from ms_slam_env.report.tables import format_number, markdown_table


def markdown_report(report: dict[str, Any]) -> str:
    """Tables of errors, times, medians and map growth from the report's dictionary."""
    parts = [f"Command: `{report['provenance']['command']}`\n"]
    parts += [f"- {name}: {text}" for name, text in report["settings"].items()]
    parts += [f"- {name} did not run: {why}" for name, why in report["missing"].items()]
    for size in dict.fromkeys(result["size"] for result in report["results"]):
        results = [result for result in report["results"] if result["size"] == size]
        parts.append(
            f"\n### {size}\n\nATE RMSE in mm, not aligned (SE(3)-aligned); processor time.\n"
        )
        parts.append(_error_table(results))
    if report["growth"]:
        parts.append("\n### Map growth over the second pass of a repeated path\n")
        rows = [
            [
                entry["sequence"],
                " ".join(str(count) for count in entry["surfels_after_pass"]),
                f"{100 * entry['growth']:+.1f} %",
                str(entry["lost_frames"]),
            ]
            for entry in report["growth"]
        ]
        header = ["sequence", "surfels after each pass", "growth", "frames lost"]
        parts.append(markdown_table(header, rows))
    return "\n".join(parts)


def _error_table(results: list[dict[str, Any]]) -> str:
    """One row a sequence and a row of medians; one column a system."""
    systems = list(dict.fromkeys(result["system"] for result in results))
    sequences = list(dict.fromkeys(result["sequence"] for result in results))
    cells = {(result["sequence"], result["system"]): result for result in results}
    rows = []
    for sequence in sequences:
        ours = cells[sequence, systems[0]]
        row = [sequence, format_number(ours["path_m"], 2)]
        row += [_cell([cells[sequence, system]]) for system in systems]
        rows.append([*row, str(ours["surfels"]), str(ours["lost_frames"])])
    medians = [_cell([cells[sequence, system] for sequence in sequences]) for system in systems]
    rows.append(["**median**", "", *medians, "", ""])
    return markdown_table(["sequence", "path, m", *systems, "surfels", "frames lost"], rows)


def _cell(results: list[dict[str, Any]]) -> str:
    """Median error and time of some results, as text."""
    raw, aligned, time = (
        float(np.median([result[key] for result in results]))
        for key in ("ate_rmse_m", "ate_rmse_aligned_m", "frame_cpu_ms")
    )
    return (
        f"{format_number(raw * 1e3, 3)} ({format_number(aligned * 1e3, 3)}), "
        f"{format_number(time, 2)} ms"
    )
