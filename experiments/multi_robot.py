"""Two or three robots, each with a SLAM of its own, their maps merged into one frame."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from ms_slam_experiments.pictures.judged_map import save_team_picture
from ms_slam_experiments.shared.teams import (
    SETTINGS,
    SHARED,
    MultiRobotSpec,
    judge_team,
    make_team,
    merge_pairs,
    place_robots,
)

from ms_slam_env.benchmark.episodes import seed_list
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import unknown
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import (
    Column,
    Grouping,
    Table,
    finished,
    flattened,
    make_table,
    measured,
)
from ms_slam_env.scenes.registry import check_name
from ms_slam_env.sensor.noise import noise_config
from ms_slam_env.slam.team.map_merging import MergeConfig

_MERGED = ("merged", "wrong_merge")
_BESIDE = {
    **{"team_ate_m": "ate_m", "team_ate_tracked_m": "ate_tracked_m", "tracked_share": ""},
    "team_rpe_m": "rpe_m",
    **{f"f_score_{n}cm": "" for n in (2, 5)},
}
"""Measures of a team and, where of another name, of a robot alone."""
_PAIR = (
    *("scene", "seed", "setting", "pair", *_MERGED, "merge_refusal", "hypotheses"),
    *("agreeing_hypotheses", "consistent_share", "photometric_correlation"),
    *("merge_error_m", "merge_error_origin_m", "merge_error_deg"),
)


@dataclass(frozen=True)
class MultiRobot(Experiment, Checked):
    """Several robots, each with a SLAM of its own, their maps merged

    Every robot is carried along its own hand-held path and maps in the frame of its first camera;
    where the robots started is not told. Maps are merged where frames of one robot are found in the
    map of another. In the setting foreign the last robot is in another scene of the same kind: its
    map must not be merged. The team is judged by the measures of USME (equations 14 to 20).
    """

    robots: int = bounded(2, 2, 3)
    """Robots in a team, 2 or 3."""
    scenes: tuple[str, ...] = ("living_room", "table", "corridor", "window")
    """Names of scenes, or mesh files."""
    settings: tuple[str, ...] = (SHARED,)
    """shared: all robots in one scene; foreign: the last one in another of the same kind."""
    seeds: str = "validation"
    """Split that the seeds come from: train, validation or test; or your own, as 7000-7003."""
    teams: int = 1
    """Seeds for each scene."""
    frames: int = bounded(200, 2, 1_000_000)
    """Length of each robot's path, at 30 Hz."""
    image_size: str = "160x120"
    """Size of the images."""
    noise: str = "kinect"
    """Noise of the sensors: kinect or none."""
    least_overlap: float = bounded(0.3, 0.0, 1.0)
    """Share of the surface a robot sees that one before it must see too."""
    merge: MergeConfig = field(default_factory=MergeConfig)
    """How maps are merged."""
    server: bool = False
    """Optimise trajectories and map jointly after merging, and compare."""
    picture: bool = True
    """Draw the map of the first team, which is run once more for it."""

    unit = "teams"

    def specs(self) -> list[MultiRobotSpec]:
        """Every team.

        Raises:
            InputError: a scene, split, size, noise or setting that does not exist.
        """
        xtion(self.image_size)
        noise_config(self.noise)
        for scene in self.scenes:
            check_name(scene)
        for setting in self.settings:
            if setting not in SETTINGS:
                raise unknown("setting", setting, SETTINGS)
        return [
            self.spec(MultiRobotSpec, scene=scene, seed=seed, setting=setting)
            for setting in self.settings
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.teams)
        ]

    @staticmethod
    def run(spec: MultiRobotSpec) -> dict[str, Any]:
        """Map, merge and judge."""
        team = make_team(spec)
        begin = time.process_time()
        merges = merge_pairs(team.robots, spec.merge)
        merge_s = time.process_time() - begin
        return {**judge_team(team, merges, spec), "merge_cpu_s": merge_s}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Merges by setting and by source of the guesses, the teams, their pairs."""
        pairs = flattened(rows, "pairs")
        errors = ("merge_error_m", "merge_error_deg")
        settings = Grouping(("setting", "robots", "same_scene"), (*_MERGED, *errors), count="pairs")
        sources = Grouping(("source",), _MERGED, count="pairs")
        note = "Pairs of robots that are in different scenes must not be merged."
        return [
            settings.table(pairs, note=note),
            sources.table(flattened(pairs, "by_source"), "With guesses of one source alone"),
            _teams(rows),
            make_table(_PAIR, [{**pair["spec"], **pair["result"]} for pair in pairs], "Pairs"),
            *([_served(rows)] if any("server" in row["result"] for row in finished(rows)) else []),
        ]

    def write_pictures(self, rows: Sequence[Row], out: Path) -> None:
        """The merged map of the first team."""
        if not self.picture:
            return
        spec = self.specs()[0]
        team = make_team(spec)
        merges = merge_pairs(team.robots, spec.merge)
        placed, found = place_robots(spec.robots, merges), judge_team(team, merges, spec)
        name = Path(spec.scene).stem
        path = out / f"map_{name}_{spec.seed}_{spec.robots}.png"
        title = f"{name}, seed {spec.seed}, {spec.robots} robots"
        save_team_picture(team, placed, found, path, title)


def _teams(rows: Sequence[Row]) -> Table:
    """Every team, and beside each measure the mean of its robots alone."""
    columns: list[Column | str] = ["scene", "seed", "setting", "robots", "merged_robots"]
    beside = {key: _BESIDE[key] or key for key in measured(tuple(_BESIDE), rows)}
    for key, own in beside.items():
        columns += [key, Column(f"alone_{key}", own, "robots alone")]
    columns += ["task_time_s", "mean_path_m"]
    lines = []
    for row in finished(rows):
        result = row["result"]
        line = {**row["spec"], **result}
        for key, own in beside.items():
            alone = [one[own] for one in result["alone"] if one[own] is not None]
            line[f"alone_{key}"] = float(np.mean(alone)) if alone else None
        lines.append(line)
    names = [column.name if isinstance(column, Column) else column for column in columns]
    lines = [{name: line[name] for name in names} for line in lines]
    return make_table(columns, lines, "Teams")


def _served(rows: Sequence[Row]) -> Table:
    """Every team before and after the server has optimised it."""
    before = dict(zip(("between_robots_m", "noise_ratio"),
                      ("merged_between_robots_m", "merged_noise_ratio"), strict=True))  # fmt: skip
    keys = ("team_ate_m", "between_robots_m", *(f"f_score_{n}cm" for n in (2, 5)), "noise_ratio")
    columns: list[Column | str] = ["scene", "seed", "robots", "server_links"]
    for key in keys:
        columns += [Column(f"merged_{key}", key, f"{metric(key).heading}, merged"), key]
    lines = []
    for row in finished(rows):
        after = row["result"].get("server")
        if after is None:
            continue
        merged = {**row["result"], **{key: after[of] for key, of in before.items()}}
        lines.append({**row["spec"], **after, **{f"merged_{key}": merged[key] for key in keys}})
    return make_table([*columns, "server_cpu_s"], lines, "After the server",
                      "Merged: laid together by the merge; else after the joint pose graph, the "
                      "frames fused anew at its poses.")  # fmt: skip
