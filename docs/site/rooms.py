"""The drawing of the rooms: `python docs/site/rooms.py` writes docs/pictures/rooms.svg.

Rooms are the folders of the package; an arrow leads from a room to one that uses it. Arrows that
follow from others are left out, as is what lies below everything (config, errors, _runtime).
"""

from __future__ import annotations

import argparse
import ast
import itertools
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "docs" / "pictures" / "rooms.svg"

ROOMS = {
    "geometry": ("rigid motions, clouds", 0),
    "camera": ("intrinsics, frames", 1),
    "scenes": ("rooms, halls, streets", 0),
    "divergence": ("the paper's equations", 2),
    "metrics": ("registry, measures", 3),
    "robot": ("free camera, arm", 0),
    "sensor": ("rays, shading, noise", 1),
    "slam": ("tracking, mapping", 2),
    "planning": ("occupancy, gain", 3),
    "report": ("tables, charts, pages", 4),
    "sequences": ("recorded, rendered", 1),
    "tuning": ("design-space search", 3),
    "evaluation": ("run and judge", 2),
    "env": ("the environment", 1),
    "benchmark": ("compare, record, check", 2),
    "baselines": ("planners", 0),
    "cli": ("ms-slam COMMAND", 2),
    "agents": ("training", 0),
    "experiments": ("the project's research", 3),
}
"""Room to what is in it and its column in the drawing; its row follows from what it uses."""
WIDTH, HEIGHT, GAP_X, GAP_Y, MARGIN = 150, 44, 18, 34, 8


def imported_rooms(folder: Path) -> set[str]:
    """The rooms that the files of a room import."""
    found = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {f"{node.module}.{alias.name}" for alias in node.names}
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
    inside = {name.split(".")[1] for name in found if name.startswith("ms_slam_env.")}
    outside = {name.split(".")[0].removeprefix("ms_slam_") for name in found}
    return (inside | (outside & {"baselines", "agents", "experiments"})) & set(ROOMS) - {
        folder.name
    }


def uses() -> dict[str, set[str]]:
    """Room to the rooms that it uses, for the rooms that there are."""
    folders = {name: ROOT / "ms_slam_env" / name for name in ROOMS}
    folders |= {name: ROOT / name for name in ("baselines", "agents", "experiments")}
    return {name: imported_rooms(path) for name, path in folders.items() if path.is_dir()}


def below(room: str, edges: dict[str, set[str]]) -> set[str]:
    """Everything that a room uses, directly or not."""
    return edges[room].union(*(below(used, edges) for used in edges[room]))


def needed(edges: dict[str, set[str]]) -> dict[str, set[str]]:
    """The arrows that do not follow from others."""
    return {
        room: {u for u in used if not any(u in below(v, edges) for v in used - {u})}
        for room, used in edges.items()
    }


def layers(edges: dict[str, set[str]]) -> list[list[str]]:
    """Rooms by the longest way down, the lowest first."""
    height: dict[str, int] = {}

    def of(room: str) -> int:
        if room not in height:
            height[room] = 1 + max((of(used) for used in edges[room]), default=-1)
        return height[room]

    ordered = sorted(edges, key=lambda room: (of(room), list(ROOMS).index(room)))
    return [list(rooms) for _, rooms in itertools.groupby(ordered, key=of)]


def draw(edges: dict[str, set[str]]) -> str:
    """The drawing as SVG, what is used above what uses it."""
    rows = layers(edges)
    columns = 1 + max(column for _, column in ROOMS.values())
    across = columns * (WIDTH + GAP_X) - GAP_X + 2 * MARGIN
    place = {
        room: (MARGIN + ROOMS[room][1] * (WIDTH + GAP_X), MARGIN + y * (HEIGHT + GAP_Y))
        for y, row in enumerate(rows)
        for room in row
    }
    down = len(rows) * (HEIGHT + GAP_Y) - GAP_Y + 2 * MARGIN
    arrows, boxes = [], []
    for room, used in needed(edges).items():
        for other in sorted(used):
            (x0, y0), (x1, y1) = place[other], place[room]
            start, end = (x0 + WIDTH / 2, y0 + HEIGHT), (x1 + WIDTH / 2, y1 - 3)
            turn = y1 - GAP_Y  # straight down to here, between two rows
            bend = (turn + end[1]) / 2
            arrows.append(
                f'<path d="M{start[0]:g},{start[1]:g} V{turn:g} C{start[0]:g},{bend:g} '
                f'{end[0]:g},{bend:g} {end[0]:g},{end[1]:g}" marker-end="url(#tip)"/>'
            )
    for room, (x, y) in place.items():
        middle = x + WIDTH / 2
        boxes.append(
            f'<rect x="{x:g}" y="{y:g}" width="{WIDTH}" height="{HEIGHT}" rx="5"/>'
            f'<text x="{middle:g}" y="{y + 18:g}" class="name">{room}</text>'
            f'<text x="{middle:g}" y="{y + 34:g}">{ROOMS[room][0]}</text>'
        )
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {across:g} {down:g}" '
            f'width="{across:g}" role="img" aria-label="The rooms and which uses which">',
            "<style>text{font:11px sans-serif;text-anchor:middle;fill:#1a2333}"
            ".name{font-weight:bold;font-size:13px}rect{fill:#e8eef7;stroke:#4a6fa5}"
            "path{fill:none;stroke:#8893a5;stroke-width:1.3}</style>",
            '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
            'markerHeight="7" orient="auto"><polygon points="0,0 8,4 0,8" fill="#8893a5"/>'
            "</marker></defs>",
            *arrows,
            *boxes,
            "</svg>\n",
        ]
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Draw the rooms of the package as SVG.")
    parser.add_argument("--out", type=Path, default=OUT, help="the SVG file to write")
    parser.parse_args().out.write_text(draw(uses()), encoding="utf-8")
