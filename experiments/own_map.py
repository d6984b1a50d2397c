"""Does SLAM find the frames of a recording again in the map that it made of the recording?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from ms_slam_experiments.relocalization import FOUND_M, Interruption, interrupt
from ms_slam_experiments.robustness import Robustness, RobustnessSpec

from ms_slam_env import slam
from ms_slam_env._runtime.threads import limit_threads
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.config import Checked, bounded, parse_named
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.report.tables import Row, Table, Value, finished, make_table, summary

COLUMNS = ("sequence", "image_size", "attempts_count", "found", "wrong", "frames_to_pose")


@dataclass(frozen=True)
class OwnMapSpec(RobustnessSpec):
    """A recording, and which of its frames are looked for; see :class:`OwnMap` for the fields."""

    every: int
    after: int


@dataclass(frozen=True)
class OwnMap(Experiment, Checked):
    """Frames of a recording in their own map: how many are found, and how many at a wrong place

    SLAM maps a recording. Then, from every ``every``-th frame that it fused into the first map, it
    is told that it is lost, and sees that frame and those after it. A frame is found if SLAM gives
    a pose within 5 cm and 5 degrees of the frame's in the finished map.
    """

    sequences: tuple[str, ...] = (
        *("living_room:2000", "corridor:2000", "table:2000", "window:2000", "carpet:2000"),
        "wall:2000",
    )
    """scene:seed[:word[+word ...]] or usme:NAME:seed."""
    recordings: tuple[str, ...] = ()
    """NAME=FOLDER, or NAME=LAYOUT:FOLDER if the layout cannot be detected."""
    image_sizes: tuple[str, ...] = ("160x120", "320x240")
    """Image sizes such as 160x120; recordings with another aspect ratio are cropped."""
    backends: tuple[str, ...] = ("surfel",)
    """NAME of a SLAM that can be told that it is lost, parameters appended."""
    every: int = bounded(8, 1, 10_000)
    """Step between the frames that are looked for."""
    after: int = bounded(5, 1, 1000)
    """Frames within which the pose must be found."""
    frames: int = bounded(150, 10, 100_000)
    """Number of frames of a rendered sequence, except USME's."""

    unit = "maps"
    tracks = True

    def specs(self) -> list[OwnMapSpec]:
        """Every map."""
        runs = Robustness(
            sequences=self.sequences,
            recordings=self.recordings,
            image_sizes=self.image_sizes,
            variations=("none",),
            backends=self.backends,
            frames=self.frames,
        )
        own = {"every": self.every, "after": self.after}
        return [OwnMapSpec(**asdict(run), **own) for run in runs.specs()]

    @staticmethod
    def run(spec: OwnMapSpec) -> dict[str, Any]:
        """Map the recording, then look for its frames."""
        limit_threads(1)
        given = spec.opened()
        name, parameters = parse_named(spec.backend, "backend")
        backend: Any = slam.make(name, given.intrinsics, **parameters)
        mapping = run_sequence(backend, given.frames, start=given.poses[0])
        is_mapped = np.array([one.fused and one.submap == 0 for one in mapping.results])
        corrected = mapping.corrected()  # later loops have bent the map
        poses = mapping.estimates if corrected is None else corrected
        state = backend.get_state()
        attempts = []
        for first in range(0, len(given) - spec.after + 1, spec.every):
            shown = slice(first, first + spec.after)
            if not is_mapped[shown].all():
                continue
            backend.set_state(state)
            backend.mark_lost()
            frames = [given.frames[index] for index in range(len(given))[shown]]
            expected = poses[shown]
            here = Interruption(0, expected, -1, 1.0)
            attempts.append({"frame": first, **interrupt(backend, here, frames, expected)})
        figures = {"frames": len(mapping), "lost_share": mapping.lost}
        return {**figures, "mapped_share": float(is_mapped.mean()), "attempts": attempts}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line for each sequence and image size, and all together."""
        cells: dict[tuple[str, str], list[Row]] = {}
        for row in finished(rows):
            spec = row["spec"]
            cells[spec["sequence"], spec["image_size"]] = row["result"]["attempts"]
        if len(cells) > 1:
            cells["all", "all"] = [one for attempts in cells.values() for one in attempts]
        lines: list[dict[str, Value]] = [
            {
                **dict(zip(COLUMNS, cell, strict=False)),
                "attempts_count": len(attempts),
                "found": summary(attempts, "found"),
                "wrong": summary(attempts, "wrong"),
                "frames_to_pose": summary(
                    [one for one in attempts if math.isfinite(one["frames_to_pose"])],
                    "frames_to_pose",
                ),
            }
            for cell, attempts in cells.items()
        ]
        return [make_table(COLUMNS, lines, note=f"Found: within {100 * FOUND_M:g} cm.")]
