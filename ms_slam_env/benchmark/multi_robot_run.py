"""One team of robots: each maps its own path in a frame of its own; maps merged and judged."""

from __future__ import annotations

import itertools
import time
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics, scenes, slam
from ms_slam_env.benchmark.multi_robot_paths import Views, team_paths
from ms_slam_env.camera import xtion
from ms_slam_env.config import check_choice, check_range
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_quality import map_quality
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.sequences import HandheldPath, render_sequence
from ms_slam_env.slam.map_hypotheses import RobotRun
from ms_slam_env.slam.map_merging import (
    Merge,
    MergeConfig,
    decide,
    find_hypotheses,
    pose_difference,
)

Float64 = NDArray[np.float64]

SHARED, FOREIGN = "shared", "foreign"
SETTINGS = (SHARED, FOREIGN)
"""All robots in one scene; or the last one in another scene of the same kind."""

WRONG_M, WRONG_DEG = 0.10, 5.0  # a merge that is off by more is wrong
_OTHER_SEED = 50_000
_SURFACE_M = 0.01
_LOOK_EVERY = 5  # frames between views that the surface to be mapped is made of


@dataclass(frozen=True)
class MultiRobotSpec:
    """A team.

    Attributes:
        scene: name or mesh file.
        seed: of the scene, the paths and the noise.
        robots: how many, 2 or 3.
        setting: one of ``SETTINGS``.
        frames: of each robot.
        image_size: such as 160x120.
        noise: of the sensors.
        least_overlap: of the surfaces that they see.
        params: of the SLAM.
        merge: how maps are merged.

    Raises:
        InputError: a value out of range.
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

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        try:
            check_range(self, "robots", 2, 3)
            check_choice(self, "setting", SETTINGS)
            check_range(self, "frames", 2, 1_000_000)
            check_range(self, "least_overlap", 0.0, 1.0)
        except InputError as error:
            # Users know the fields as options of a command, not this class.
            raise InputError(str(error).replace("MultiRobotSpec.", "")) from None


@dataclass(frozen=True)
class Team:
    """Robots that have mapped their paths.

    Attributes:
        robots: M runs, each in the frame of its first camera.
        truths: M true trajectories (N, 4, 4), T_world_camera.
        times: M time stamps (N,), seconds.
        surface: (P, 3) points of the whole scene's surface, world frame.
        seen: (Q, 3) points of the surface that the true trajectories saw.
        overlaps: of every robot but the first with one before.
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


def run_team(spec: MultiRobotSpec) -> dict[str, Any]:
    """Map, merge and judge; the figures by name, see ``judge_team``."""
    team = make_team(spec)
    begin = time.process_time()
    merges = merge_pairs(team.robots, spec.merge)
    merge_s = time.process_time() - begin
    return {**judge_team(team, merges, spec), "merge_cpu_s": merge_s}


def make_team(spec: MultiRobotSpec) -> Team:
    """Render what each robot sees and let its SLAM map it.

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
        backend.reset()
        results = [backend.track(frame) for frame in frames]
        runs.append(
            RobotRun(
                backend,
                frames,
                np.stack([result.T_world_camera for result in results]),
                np.array([result.tracking_ok for result in results]),
            )
        )
    here = [truth for place, truth in zip(own, poses, strict=True) if place is scene]
    seen = Views(scene).points(np.concatenate(here)[::_LOOK_EVERY], _SURFACE_M)
    surface = scene.surface_points(_SURFACE_M)[0]
    return Team(runs, poses, [path.timestamps] * spec.robots, surface, seen, overlaps)


@dataclass(frozen=True)
class PairMerge:
    """What came of merging two maps, from all guesses and from those of each source alone."""

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
    """T_0_b (4, 4) by robot b, of those that can be brought into the first one's frame.

    Links that more guesses agree on are taken first.
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
    """Figures of a team, of the robots that were merged with the first and of each alone.

    ``pairs``: of each pair what came of it, with ``error_m`` (at robot b's mean camera position),
    ``error_origin_m`` (at the origin of its frame) and ``error_deg`` of T_a_b, and ``wrong``;
    ``alone`` has the same from the guesses of each source alone. ``merged_robots``;
    ``team_ate_m``, ``team_ate_max_m`` (one SE(3) alignment for all), ``team_ate_unaligned_m``
    (the first robot's start is the only tie), ``team_rpe_m``, ``task_time_s``, ``mean_path_m``;
    ``map_...`` of the merged map against all that the robots saw; ``robots``: the same of each
    robot alone, its map tied by its own true start.
    """
    foreign = len(team.robots) - 1 if spec.setting == FOREIGN else None
    pairs = []
    for (a, b), pair in merges.items():
        same_scene = foreign not in (a, b)
        alone = {
            name: _judge_merge(team, a, b, merge, same_scene) for name, merge in pair.alone.items()
        }
        entry = _judge_merge(team, a, b, pair.merge, same_scene)
        pairs.append({"a": a, "b": b, "same_scene": same_scene, **entry, "alone": alone})
    T_first = place_robots(len(team.robots), merges)
    members = list(T_first)
    T_world_first = team.truths[0][0]
    estimates, truths, points = [], [], []
    for k in members:
        T = T_world_first @ T_first[k]
        estimates.append(T @ team.robots[k].estimates)
        truths.append(team.truths[k])
        points.append(transform_points(T, team.robots[k].backend.surface_points()))
    ate = metrics.team_ate(estimates, truths)
    merged_map = map_quality(np.concatenate(points), team.surface, reference=team.seen)
    return {
        "pairs": pairs,
        "path_overlaps": team.overlaps,
        "merged_robots": len(members),
        "team_ate_m": ate.rmse,
        "team_ate_max_m": ate.max,
        "team_ate_unaligned_m": metrics.team_ate(estimates, truths, "none").rmse,
        "team_rpe_m": metrics.team_rpe(estimates, truths).rmse,
        "task_time_s": metrics.task_time([team.times[k] for k in members]),
        "mean_path_m": metrics.mean_path_length(truths),
        **{f"map_{name}": value for name, value in merged_map.items()},
        "robots": [_alone(team, k) for k in range(len(team.robots)) if k != foreign],
    }


def _judge_merge(team: Team, a: int, b: int, merge: Merge, same_scene: bool) -> dict[str, Any]:
    """Figures of one attempt; see ``judge_team``."""
    entry: dict[str, Any] = {
        **{"merged": merge.T_a_b is not None, "reason": merge.reason, "wrong": False},
        **{"found": merge.found, "agreeing": merge.agreeing, "refined_m": merge.refined_m},
        **asdict(merge.fit),
    }
    if merge.T_a_b is not None:
        entry |= pair_error(team, a, b, merge.T_a_b)
        off = entry["error_m"] > WRONG_M or entry["error_deg"] > WRONG_DEG
        entry["wrong"] = bool(off or not same_scene)
    return entry


def pair_error(team: Team, a: int, b: int, T_a_b: Float64) -> dict[str, float]:
    """Error of a relative pose; see ``judge_team``."""
    true = team.true_pose(a, b)
    centre = team.robots[b].estimates[:, :3, 3].mean(axis=0)
    error_m, error_deg = pose_difference(T_a_b, true, centre)
    origin_m = pose_difference(T_a_b, true, np.zeros(3))[0]
    return {"error_m": error_m, "error_origin_m": origin_m, "error_deg": error_deg}


def _alone(team: Team, k: int) -> dict[str, Any]:
    """A robot without the others."""
    robot, truth = team.robots[k], team.truths[k]
    points = transform_points(truth[0], robot.backend.surface_points())
    return {
        "ate_m": metrics.ate_rmse(robot.estimates, truth),
        "ate_unaligned_m": metrics.ate_rmse(truth[0] @ robot.estimates, truth, align="none"),
        "rpe_m": metrics.rpe_rmse(robot.estimates, truth),
        "lost_share": 1.0 - float(robot.tracked.mean()),
        "path_m": metrics.path_length(truth),
        **{
            f"map_{name}": value
            for name, value in map_quality(points, team.surface, reference=team.seen).items()
        },
    }
