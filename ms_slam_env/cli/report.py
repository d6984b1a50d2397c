"""``ms-slam report``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from ms_slam_env._runtime.command_line import parse
from ms_slam_env._runtime.output_files import check_out_file


@dataclass(frozen=True)
class Arguments:
    """Turn a folder of results into one HTML page with interactive figures and sortable tables.

    Reads the --out folder of any other command; a folder of such folders becomes one page with a
    table of contents. The page works offline and needs no other file.
    """

    folder: tyro.conf.Positional[Path]
    """Folder of results."""
    out: Path | None = None
    """The page; by default report.html in the folder."""


def main(arguments: Sequence[str]) -> int:
    """Write the page and print where it is."""
    args = parse(Arguments, arguments, "ms-slam report", check_out_file)
    from ms_slam_env.report.page import write_report

    path = write_report(args.folder, args.out)
    print(f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0
