"""``ms-slam docs``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import tyro

from ms_slam_env._runtime.command_line import parse
from ms_slam_env.errors import InputError

_PAGES = ("README.md",)


@dataclass(frozen=True)
class Arguments:
    """Write the tables of a clone's Markdown pages from its results, or pack results to commit.

    A table stands between <!-- results: FOLDER table=0 columns=planner,ate_m --> and
    <!-- end -->; FOLDER is one of docs/results. Model cards stand between <!-- agents: FILE -->
    and <!-- end -->; FILE is a policy, or a folder of them. Which planner leads each of some
    benchmarks stands between <!-- leaders: FOLDER ... by=f_score_5cm --> and <!-- end -->.
    """

    pages: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Pages; by default README.md and those in docs."""
    root: Path = Path()
    """Root of the clone."""
    check: bool = False
    """Change nothing; exit with 1 if a page is out of date."""
    pack: tuple[Path, Path] | None = None
    """Compress a folder written with --out into a folder of docs/results: SOURCE TARGET. Files that
    are in both, such as a picture shown on a page, are replaced. No page is written."""


def main(arguments: Sequence[str]) -> int:
    """Write the tables, or check them, and print the pages that were out of date."""
    args = parse(Arguments, arguments, "ms-slam docs")
    from ms_slam_env.benchmark.experiment import IN_A_CLONE
    from ms_slam_env.benchmark.planner_tables import with_privilege
    from ms_slam_env.report.results import pack_results

    if args.pack:
        for path in pack_results(*args.pack):
            print(f"{path}: {path.stat().st_size:,} bytes")
        return 0
    pages = args.pages or pages_of(args.root)
    if not pages:
        raise InputError(f"{args.root} holds no pages: no {_PAGES[0]} and no Markdown in docs")
    if find_spec("ms_slam_docs") is None:
        raise InputError(f"what writes pages is not installed: {IN_A_CLONE}")
    results = args.root / "docs" / "results"
    update = import_module("ms_slam_docs.markdown_pages").update_pages
    changed = update(pages, results, not args.check, with_privilege)
    for page in changed:
        print(f"{page}: {'out of date' if args.check else 'written'}")
    if args.check and changed:
        print("ms-slam: error: run ms-slam docs", file=sys.stderr)
        return 1
    return 0


def pages_of(root: Path) -> tuple[Path, ...]:
    """List the pages of a clone, without the Markdown in folders of docs/results."""
    results = root / "docs" / "results"
    found = [root / name for name in _PAGES if (root / name).is_file()]
    found += [
        path
        for path in sorted((root / "docs").rglob("*.md"))
        if path.parent == results or not path.is_relative_to(results)
    ]
    return tuple(found)
