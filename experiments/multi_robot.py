"""Merge the maps of two or three robots, each with its own SLAM, into one frame."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics, scenes, slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.episodes import seed_list
from ms_slam_env.benchmark.experiment import Experiment, check_each
from ms_slam_env.camera import xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_quality import map_quality
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.geometry.point_clouds import voxel_downsample
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
from ms_slam_env.scenes import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences import HandheldPath, render_sequence
from ms_slam_env.slam.team.map_merging import (
    Merge,
    MergeConfig,
    decide,
    find_hypotheses,
    pose_difference,
)
from ms_slam_env.slam.team.relative_map_poses import RobotRun
from ms_slam_env.slam.team.team_server import fuse_team, optimise_team

SHARED, FOREIGN = "shared", "foreign"
SETTINGS = (SHARED, FOREIGN)
"""All robots in one scene; or the last one in another scene of the same kind."""

WRONG_M, WRONG_DEG = 0.10, 5.0  # a merge with a larger error is wrong
_OTHER_SEED = 50_000
_SURFACE_M = 0.01
_LOOK_EVERY = 5  # frames between the views that define the surface to map

VOXEL_M = 0.10
_ATTEMPTS = 30
_SEEDS_A_ROBOT = 1000
_LOOKS = 25  # poses of a path from which views are taken
_REACH_M = 4.0  # of the sensor


@dataclass(frozen=True)
class MultiRobotSpec:
    """A team.

    Attributes:
        scene: name or mesh file.
        seed: seed of the scene, the paths and the noise.
        robots: number of robots, 2 or 3.
        setting: one of ``SETTINGS``.
        frames: number of frames of each robot.
        image_size: such as 160x120.
        noise: noise of the sensors.
        least_overlap: smallest overlap of the surfaces that they see.
        params: parameters of SLAM.
        merge: how to merge maps.
        server: whether to optimise trajectories and map after merging, too.
    """

    scene: str = "living_room"
    seed: int = 1000
    robots: int = 2
    setting: str = SHARED
    frames: int = 200
    image_size: str = "160x120"
    noise: str = "kinect"
    least_overlap: float = 0.3
    params: dict[str, Any] = field(default_factory=dict)
    merge: MergeConfig = field(default_factory=MergeConfig)
    server: bool = False


@dataclass(frozen=True)
class Team:
    """Robots that have mapped their paths.

    Attributes:
        robots: M runs, each in the frame of its first camera.
        truths: M true trajectories (N, 4, 4), T_world_camera.
        times: M time stamps (N,), seconds.
        surface: (P, 3) points of the whole scene's surface, world frame.
        seen: (Q, 3) points of the surface that the true trajectories saw.
        overlaps: largest overlap of every robot but the first with an earlier one.
    """

    robots: list[RobotRun]
    truths: list[Float64]
    times: list[Float64]
    surface: Float64
    seen: Float64
    overlaps: list[float]

    def true_pose(self, a: int, b: int) -> Float64:
        """True T_a_b (4, 4) of two robots' frames."""
        return invert(self.truths[a][0]) @ self.truths[b][0]


def make_team(spec: MultiRobotSpec) -> Team:
    """Render the frames of each robot and map them with its SLAM.

    Raises:
        InputError: a scene, size, noise or parameter that does not exist, or no paths.
    """
    scene = scenes.make(spec.scene, spec.seed)
    own = [scene] * spec.robots
    path = HandheldPath(frames=spec.frames)
    if spec.setting == FOREIGN:
        own[-1] = scenes.make(spec.scene, spec.seed + _OTHER_SEED)
        together = spec.robots - 1
        poses, overlaps = team_paths(scene, path, spec.seed, together, spec.least_overlap)
        poses += team_paths(own[-1], path, spec.seed + _OTHER_SEED, 1, 0.0)[0]
        overlaps.append(0.0)
    else:
        poses, overlaps = team_paths(scene, path, spec.seed, spec.robots, spec.least_overlap)
    K = xtion(spec.image_size)
    runs = []
    for number, (place, truth) in enumerate(zip(own, poses, strict=True)):
        noise_seed = 10 * spec.seed + number
        frames = tuple(render_sequence(place, truth, K, spec.noise, noise_seed).frames)
        backend = slam.make("surfel", K, **spec.params)
        run = run_sequence(backend, frames)
        runs.append(RobotRun(backend, frames, run.estimates, run.tracking_ok))
    here = [truth for place, truth in zip(own, poses, strict=True) if place is scene]
    seen = Views(scene).points(np.concatenate(here)[::_LOOK_EVERY], _SURFACE_M)
    surface = scene.surface_points(_SURFACE_M)[0]
    return Team(runs, poses, [path.timestamps] * spec.robots, surface, seen, overlaps)


class Views:
    """Surface seen from a path, as occupied voxels of ``VOXEL_M``."""

    def __init__(self, scene: Scene) -> None:
        """Prepare to render views of a scene."""
        self._sensor = RGBDSensor(scene, xtion("80x60"), noise="none")

    def of(self, poses: Float64) -> set[tuple[int, ...]]:
        """Voxels seen from poses (N, 4, 4)."""
        points = self.points(poses[:: max(1, len(poses) // _LOOKS)], VOXEL_M)
        return set(map(tuple, np.floor(points / VOXEL_M).astype(int).tolist()))

    def points(self, poses: Float64, voxel_m: float) -> Float64:
        """Points (M, 3) of the true surface seen from poses (N, 4, 4), one per voxel."""
        seen = []
        for pose in poses:
            view = self._sensor.ground_truth(pose)
            near = (view.depth > 0) & (view.depth <= _REACH_M)
            seen.append(view.points[near].astype(np.float64))
        return voxel_downsample(np.concatenate(seen), voxel_m)


def overlap(a: set[tuple[int, ...]], b: set[tuple[int, ...]]) -> float:
    """Share of the smaller of two sets of voxels that is also in the other."""
    return len(a & b) / max(1, min(len(a), len(b)))


def team_paths(
    scene: Scene, path: HandheldPath, seed: int, robots: int, least_overlap: float
) -> tuple[list[Float64], list[float]]:
    """A path for each robot that sees enough of the surface that an earlier robot sees.

    Args:
        scene: scene of the paths.
        path: kind of path.
        seed: seed of the paths.
        robots: number of robots.
        least_overlap: share of the smaller surface seen, [0, 1]; 0 accepts any path.

    Returns:
        paths (N, 4, 4), and for every robot but the first its largest overlap with one before.

    Raises:
        InputError: no free path, or none that overlaps.
    """
    views = Views(scene)
    paths: list[Float64] = []
    seen: list[set[tuple[int, ...]]] = []
    overlaps: list[float] = []
    for robot in range(robots):
        for attempt in range(_ATTEMPTS):
            number = (seed * robots + robot) * _SEEDS_A_ROBOT + attempt
            poses = path.poses(scene, number)
            voxels = views.of(poses)
            shared = max((overlap(voxels, other) for other in seen), default=1.0)
            if shared >= least_overlap:
                break
        else:
            raise InputError(
                f"found no path of robot {robot} in scene {scene.name!r}, seed {scene.seed}, that "
                f"shares {100 * least_overlap:.0f} % of what another sees"
            )
        paths.append(poses)
        seen.append(voxels)
        overlaps.append(shared)
    return paths, overlaps[1:]


@dataclass(frozen=True)
class PairMerge:
    """Result of merging two maps, with all hypotheses and with those of each source alone."""

    merge: Merge
    alone: dict[str, Merge] = field(default_factory=dict)


def merge_pairs(robots: list[RobotRun], config: MergeConfig) -> dict[tuple[int, int], PairMerge]:
    """Merge every pair of maps; the result by pair (a, b), a < b."""
    found = {}
    for a, b in itertools.combinations(range(len(robots)), 2):
        guesses = find_hypotheses(robots[a], robots[b], config)
        merge = decide(robots[a], robots[b], guesses, config)
        alone = {}
        for source in config.sources:
            some = [guess for guess in guesses if guess.source == source]
            is_all = len(some) == len(guesses)
            alone[source] = merge if is_all else decide(robots[a], robots[b], some, config)
        found[a, b] = PairMerge(merge, alone)
    return found


def place_robots(count: int, merges: dict[tuple[int, int], PairMerge]) -> dict[int, Float64]:
    """T_0_b (4, 4) by robot b, for the robots that can be brought into the first one's frame.

    Links that more hypotheses agree on are used first.
    """
    placed = {0: np.eye(4)}
    while True:
        links = [
            (pair.merge.agreeing, a, b, T)
            for (i, j), pair in merges.items()
            if pair.merge.T_a_b is not None
            for a, b, T in ((i, j, pair.merge.T_a_b), (j, i, invert(pair.merge.T_a_b)))
            if a in placed and b not in placed
        ]
        if not links:
            return dict(sorted(placed.items()))
        _, a, b, T_a_b = max(links, key=lambda link: link[0])
        placed[b] = placed[a] @ T_a_b


def judge_team(
    team: Team, merges: dict[tuple[int, int], PairMerge], spec: MultiRobotSpec
) -> dict[str, Any]:
    """Measures of the robots merged with the first, and of each robot alone.

    Keys are those of the metric registry: the result of each pair, and ``by_source`` with the
    hypotheses of one source; errors of the trajectories (with one SE(3) alignment for all, and
    with only the first robot's start aligned); the merged map compared with everything the robots
    saw; ``alone``: each robot on its own, with its map placed by its true start.
    """
    foreign = len(team.robots) - 1 if spec.setting == FOREIGN else None
    pairs = []
    for (a, b), pair in merges.items():
        same_scene = foreign not in (a, b)
        by_source = [
            {"source": name, **_judge_merge(team, a, b, merge, same_scene)}
            for name, merge in pair.alone.items()
        ]
        entry = _judge_merge(team, a, b, pair.merge, same_scene)
        about = {"pair": f"{a}-{b}", "same_scene": same_scene}
        pairs.append({**about, **entry, "by_source": by_source})
    T_first = {k: team.truths[0][0] @ T for k, T in place_robots(len(team.robots), merges).items()}
    members = list(T_first)
    estimates = [T @ team.robots[k].estimates for k, T in T_first.items()]
    points = [
        transform_points(T, team.robots[k].backend.surface_points()) for k, T in T_first.items()
    ]
    truths = [team.truths[k] for k in members]
    return {
        "pairs": pairs,
        "path_overlaps": team.overlaps,
        "merged_robots": len(members),
        **team_errors(estimates, truths, [team.robots[k].tracked for k in members]),
        "task_time_s": metrics.task_time([team.times[k] for k in members]),
        "mean_path_m": metrics.mean_path_length(truths),
        **map_quality(np.concatenate(points), team.surface, reference=team.seen),
        **({"server": serve(team, T_first, spec)} if spec.server else {}),
        "alone": [_alone(team, k) for k in range(len(team.robots)) if k != foreign],
    }


def team_errors(
    estimates: list[Float64], truths: list[Float64], tracked: list[NDArray[np.bool_]]
) -> dict[str, Any]:
    """Errors of the trajectories (N, 4, 4) of a team in one world frame, by registry key."""
    ate = metrics.team_ate(estimates, truths)
    joined = np.concatenate(estimates), np.concatenate(truths), np.concatenate(tracked)
    own = metrics.tracked_errors(*joined)
    return {
        "team_ate_m": ate.rmse,
        "team_ate_tracked_m": own["ate_tracked_m"],
        "tracked_share": own["tracked_share"],
        "team_ate_max_m": ate.max,
        "team_ate_unaligned_m": metrics.team_ate(estimates, truths, "none").rmse,
        "team_rpe_m": metrics.team_rpe(estimates, truths).rmse,
    }


def serve(team: Team, T_world_map: dict[int, Float64], spec: MultiRobotSpec) -> dict[str, Any]:
    """The team's measures after the server has optimised the trajectories and fused the map again.

    ``server_cpu_s`` is the processor time of the pose graph, without the fusion; ``noise_ratio`` is
    that of the fused map, ``merged_noise_ratio`` that of the merged maps before fusion.
    """
    began = time.process_time()
    made = optimise_team(team.robots, T_world_map)
    seconds = time.process_time() - began
    estimates = list(made.trajectories.values())
    truths = [team.truths[k] for k in made.trajectories]
    before = [T @ team.robots[k].estimates for k, T in T_world_map.items()]
    K = team.robots[0].backend.intrinsics
    mapper = slam.make("surfel", K, **{"motion_mask": "none", **spec.params})
    fused = fuse_team(mapper, team.robots, made).surface_points()
    laid = np.concatenate([
        transform_points(T, team.robots[k].backend.surface_points())
        for k, T in T_world_map.items()
    ])  # fmt: skip
    several = len(estimates) > 1
    return {
        **team_errors(estimates, truths, [team.robots[k].tracked for k in made.trajectories]),
        "between_robots_m": metrics.inter_robot_rpe(estimates, truths).rmse if several else None,
        "merged_between_robots_m": (
            metrics.inter_robot_rpe(before, truths).rmse if several else None
        ),
        "server_links": made.links,
        "server_cpu_s": seconds,
        "noise_ratio": metrics.noise_ratio(fused, team.surface),
        "merged_noise_ratio": metrics.noise_ratio(laid, team.surface),
        **map_quality(fused, team.surface, reference=team.seen),
    }


def _judge_merge(team: Team, a: int, b: int, merge: Merge, same_scene: bool) -> dict[str, Any]:
    """Measures of one attempt to merge robot b's map into robot a's."""
    fit = merge.fit
    entry: dict[str, Any] = {
        "merged": merge.T_a_b is not None,
        "merge_refusal": merge.reason,
        "wrong_merge": False,
        "hypotheses": merge.found,
        "agreeing_hypotheses": merge.agreeing,
        "refined_m": merge.refined_m,
        "overlap_share": fit.overlap,
        "consistent_share": fit.consistent,
        "photometric_correlation": fit.alike,
    }
    if merge.T_a_b is not None:
        entry |= pair_error(team, a, b, merge.T_a_b)
        off = entry["merge_error_m"] > WRONG_M or entry["merge_error_deg"] > WRONG_DEG
        entry["wrong_merge"] = bool(off or not same_scene)
    return entry


def pair_error(team: Team, a: int, b: int, T_a_b: Float64) -> dict[str, float]:
    """Error of a relative pose, at robot b's mean camera position and at its frame's origin."""
    true = team.true_pose(a, b)
    centre = team.robots[b].estimates[:, :3, 3].mean(axis=0)
    error_m, error_deg = pose_difference(T_a_b, true, centre)
    origin_m = pose_difference(T_a_b, true, np.zeros(3))[0]
    return {
        "merge_error_m": error_m,
        "merge_error_origin_m": origin_m,
        "merge_error_deg": error_deg,
    }


def _alone(team: Team, k: int) -> dict[str, Any]:
    """Measures of a robot without the others."""
    robot, truth = team.robots[k], team.truths[k]
    points = transform_points(truth[0], robot.backend.surface_points())
    return {
        "ate_m": metrics.ate_rmse(robot.estimates, truth),
        **metrics.tracked_errors(robot.estimates, truth, robot.tracked),
        "ate_unaligned_m": metrics.ate_rmse(truth[0] @ robot.estimates, truth, align="none"),
        "rpe_m": metrics.rpe_rmse(robot.estimates, truth),
        "lost_share": 1.0 - float(robot.tracked.mean()),
        "path_length_m": metrics.path_length(truth),
        **map_quality(points, team.surface, reference=team.seen),
    }


_MERGED = ("merged", "wrong_merge")
_BESIDE = {
    **{"team_ate_m": "ate_m", "team_ate_tracked_m": "ate_tracked_m", "tracked_share": ""},
    "team_rpe_m": "rpe_m",
    **{f"f_score_{n}cm": "" for n in (2, 5)},
}
"""Measure of a team to that of a robot alone; empty if they have the same name."""
_PAIR = (
    *("scene", "seed", "setting", "pair", *_MERGED, "merge_refusal", "hypotheses"),
    *("agreeing_hypotheses", "consistent_share", "photometric_correlation"),
    *("merge_error_m", "merge_error_origin_m", "merge_error_deg"),
)


@dataclass(frozen=True)
class MultiRobot(Experiment, Checked):
    """Several robots, each with a SLAM of its own, their maps merged

    Every robot follows its own hand-held path and maps in the frame of its first camera; the start
    poses of the others are unknown. Maps are merged where frames of one robot are recognised in the
    map of another. In the setting foreign, the last robot is in another scene of the same kind, and
    its map must not be merged. The team is evaluated by USME's measures (equations 14 to 20).
    """

    robots: int = bounded(2, 2, 3)
    """Number of robots in a team, 2 or 3."""
    scenes: tuple[str, ...] = ("living_room", "table", "corridor", "window")
    """Names of scenes, or mesh files."""
    settings: tuple[str, ...] = (SHARED,)
    """shared: all robots in one scene; foreign: the last one in another scene of the same kind."""
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
    """Least share of the surface seen by a robot that an earlier robot must see, too."""
    merge: MergeConfig = field(default_factory=MergeConfig)
    """How to merge maps."""
    server: bool = False
    """Optimise trajectories and map jointly after merging, and compare."""

    unit = "teams"

    def specs(self) -> list[MultiRobotSpec]:
        """Every team."""
        check_each("setting", self.settings, SETTINGS)
        seeds = seed_list(self.seeds, self.teams)
        return self.each(MultiRobotSpec, setting=self.settings, scene=self.scenes, seed=seeds)

    @staticmethod
    def run(spec: MultiRobotSpec) -> dict[str, Any]:
        """Map, merge and evaluate."""
        team = make_team(spec)
        begin = time.process_time()
        merges = merge_pairs(team.robots, spec.merge)
        merge_s = time.process_time() - begin
        return {**judge_team(team, merges, spec), "merge_cpu_s": merge_s}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Merges by setting and by source of hypotheses, the teams, and their pairs."""
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


def _teams(rows: Sequence[Row]) -> Table:
    """Every team, with the mean of its robots alone beside each measure."""
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
