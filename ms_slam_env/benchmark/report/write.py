"""Write the report of a folder."""

from __future__ import annotations

import os
from pathlib import Path

from ms_slam_env.benchmark.report.discovery import find_results
from ms_slam_env.benchmark.report.page import page
from ms_slam_env.benchmark.report.sections import section_of
from ms_slam_env.errors import InputError


def write_report(folder: Path, out: Path | None = None) -> Path:
    """One self-contained HTML page of every result in ``folder`` and below.

    An interrupt leaves the old page or the new one, never half of one.

    Args:
        folder: of results of any of the commands and benchmarks.
        out: the page; by default ``report.html`` in ``folder``.

    Returns:
        path of the page.

    Raises:
        InputError: no such folder, no result in it, a broken result file, Plotly not installed.
    """
    results = find_results(folder)
    target = folder / "report.html" if out is None else out
    if target.is_dir():
        raise InputError(f"--out {target} is a folder; a file is needed, such as report.html")
    html = page(folder.resolve().name, [section_of(result) for result in results])
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(target.name + ".partial")
    partial.write_text(html, encoding="utf-8")
    os.replace(partial, target)
    return target
