"""Two or three robots, each with a SLAM of its own, their maps merged into one frame.

Every robot is carried along its own hand-held path through one scene and maps it in the frame of
its first camera; where the robots started is not told. Maps are merged where frames of one robot
are found in the map of another (:mod:`.map_merging`), and the team is judged by the measures of
USME (equations 14 to 20). In the setting ``foreign`` the last robot is in another scene of the
same kind: its map must not be merged. Run as ``python -m ms_slam_env.benchmark.multi_robot
--robots 2``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ms_slam_env.benchmark import multi_robot_report as report
from ms_slam_env.benchmark.multi_robot_run import (
    SHARED,
    MultiRobotSpec,
    judge_team,
    make_team,
    merge_pairs,
    place_robots,
    run_team,
)
from ms_slam_env.camera import xtion
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.experiments.harness.episodes import seed_list
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.scenes.registry import check_name
from ms_slam_env.sensor.noise import noise_config
from ms_slam_env.slam.map_merging import MergeConfig

PROGRAM = "python -m ms_slam_env.benchmark.multi_robot"


@dataclass(frozen=True)
class Arguments:
    """Teams of robots: scenes x seeds, each in every setting."""

    robots: int = 2
    """Robots in a team, 2 or 3."""
    scenes: tuple[str, ...] = ("living_room", "table", "corridor", "window")
    """Names of scenes, or mesh files."""
    settings: tuple[str, ...] = (SHARED,)
    """shared: all robots in one scene; foreign: the last one in another of the same kind."""
    seeds: str = "validation"
    """Split that the seeds come from: train, validation or test."""
    teams: int = 1
    """Seeds for each scene."""
    frames: int = 200
    """Length of each robot's path, at 30 Hz."""
    image_size: str = "160x120"
    """Size of the images."""
    noise: str = "kinect"
    """Noise of the sensors: kinect or none."""
    least_overlap: float = 0.3
    """Share of the surface a robot sees that one before it must see too."""
    merge: MergeConfig = field(default_factory=MergeConfig)
    """How maps are merged."""
    picture: bool = True
    """Draw the map of the first team of each number of robots."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/multi_robot")
    """Folder of the results."""

    def specs(self) -> list[MultiRobotSpec]:
        """Every team.

        Raises:
            InputError: a scene, split, size, noise or number that does not exist.
        """
        xtion(self.image_size)
        noise_config(self.noise)
        for scene in self.scenes:
            check_name(scene)
        return [
            MultiRobotSpec(
                scene,
                seed,
                self.robots,
                setting,
                self.frames,
                self.image_size,
                self.noise,
                self.least_overlap,
                merge=self.merge,
            )
            for setting in self.settings
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.teams)
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, write and print the tables; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    specs = args.specs()
    rows = run_all(specs, run_team, args.out, args.workers, "teams")
    check_any_finished(rows)
    finished = [row for row in rows if row["error"] is None]
    summary = report.summarise(finished)
    content: dict[str, Any] = {
        "provenance": provenance(),
        "config": asdict(args) | {"out": str(args.out)},
        "summary": summary,
        "teams": [{**row["spec"], **row["result"]} for row in finished],
    }
    write_json(args.out / "multi_robot.json", content)
    text = report.as_markdown(finished, summary)
    (args.out / "table.md").write_text(text, encoding="utf-8")
    if args.picture and specs:
        draw(specs[0], args.out)
    print(text)
    return report_failures(failures(rows), PROGRAM)


def draw(spec: MultiRobotSpec, out: Path) -> Path:
    """Run a team once more and draw its merged map."""
    team = make_team(spec)
    merges = merge_pairs(team.robots, spec.merge)
    found = judge_team(team, merges, spec)
    title = f"{Path(spec.scene).stem}, seed {spec.seed}, {spec.robots} robots"
    path = out / f"map_{Path(spec.scene).stem}_{spec.seed}_{spec.robots}.png"
    placed = place_robots(spec.robots, merges)
    return report.save_picture(team, placed, found, path, title)


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
