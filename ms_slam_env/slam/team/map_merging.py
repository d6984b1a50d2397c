"""Finds the relative pose of two robots' maps from what both saw, or refuses.

Every robot's SLAM has its own frame. Frames of one robot yield hypotheses of its map's pose in the
other's map (:mod:`.relative_map_poses`), by matching similar points and by relocalisation. A pose
that enough hypotheses agree on is refined by registration of the maps. It is accepted if each
robot's images resemble the views that the other's map predicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import bounded
from ms_slam_env.errors import unknown
from ms_slam_env.geometry import invert, relative_angle, se3_exp, se3_log, transform_points
from ms_slam_env.geometry.cloud_registration import register_clouds
from ms_slam_env.geometry.point_clouds import voxel_downsample
from ms_slam_env.slam.shared.map_fit import Fit, FitConfig, measure_fit, why_not_believed
from ms_slam_env.slam.team.relative_map_poses import (
    SOURCES,
    Hypothesis,
    RobotRun,
    hypotheses_from_features,
    hypotheses_from_relocalisation,
)

AGREE_M, AGREE_DEG = 0.10, 5.0  # hypotheses agree if robot b's cameras differ by less than this
LEAST_AGREEING, LEAST_SHARE = 3, 0.6  # hypotheses that must agree, and their share of all
_SLACK = 0.01  # largest loss that registration may cause in a share of pixels


@dataclass(frozen=True)
class MergeConfig(FitConfig):
    """Parameters of map merging.

    Attributes:
        sources: sources of the hypotheses.
        queries: number of frames per robot for feature matching and for verification.
        lost_queries: number of positions on each robot's path from which it is relocalised in the
            other's map.
        patience: number of consecutive frames tried at each position.
        voxel_m: voxel size for downsampling the maps before registration.
        cutoff_m: largest distance of corresponding points in the registration.
    """

    sources: tuple[str, ...] = SOURCES
    queries: int = bounded(24, 1, 10_000)
    lost_queries: int = bounded(8, 1, 10_000)
    patience: int = bounded(4, 2, 1000)
    voxel_m: float = bounded(0.02, 1e-3, 1.0)
    cutoff_m: float = bounded(0.10, 1e-3, 10.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for source in self.sources:
            if source not in SOURCES:
                raise unknown("source of guesses", source, SOURCES)


@dataclass(frozen=True)
class Merge:
    """Outcome of a merge attempt."""

    # (4, 4) transforms points of map b into map a; None if the maps were not merged.
    T_a_b: Float64 | None
    reason: str  # why they were not merged; empty if they were
    found: int = 0  # number of hypotheses
    agreeing: int = 0  # largest number of them that agree
    fit: Fit = field(default_factory=Fit)  # of the maps; NaN if no pose was verified
    # distance that registration moved b's cameras, metres; 0 if it was not accepted.
    refined_m: float = 0.0


def merge_maps(a: RobotRun, b: RobotRun, config: MergeConfig | None = None) -> Merge:
    """Find T_a_b from the robots' frames, or say why no pose is accepted."""
    config = config or MergeConfig()
    return decide(a, b, find_hypotheses(a, b, config), config)


def find_hypotheses(a: RobotRun, b: RobotRun, config: MergeConfig) -> list[Hypothesis]:
    """Collect hypotheses of T_a_b from the frames of both robots."""
    found: list[Hypothesis] = []
    if SOURCES[0] in config.sources:
        found += hypotheses_from_features(a, b, config.queries)
    if SOURCES[1] in config.sources:
        found += hypotheses_from_relocalisation(a, b, config.lost_queries, config.patience)
        found += [
            Hypothesis(invert(back.T_a_b), back.weight, back.source)
            for back in hypotheses_from_relocalisation(b, a, config.lost_queries, config.patience)
        ]
    return found


def decide(
    a: RobotRun, b: RobotRun, hypotheses: Sequence[Hypothesis], config: MergeConfig
) -> Merge:
    """Refine the pose that the hypotheses agree on, and accept it if the maps confirm it."""
    if not (a.tracked.any() and b.tracked.any()):
        return Merge(None, "a robot has tracked no frame")
    centre = b.estimates[b.tracked, :3, 3].mean(axis=0)
    agreeing = consensus(hypotheses, centre, AGREE_M, AGREE_DEG)
    counts = len(hypotheses), len(agreeing)
    if len(agreeing) < LEAST_AGREEING:
        return Merge(None, "too few frames show the other map", *counts)
    if len(agreeing) < LEAST_SHARE * len(hypotheses):
        return Merge(None, "the frames contradict each other", *counts)
    T_a_b, refined_m = mean_pose(agreeing, centre), 0.0
    fit = measure_fit(a, b, T_a_b, config)
    refined = refine(a, b, T_a_b, config)
    moved_m, moved_deg = pose_difference(refined, T_a_b, centre)
    if moved_m < AGREE_M and moved_deg < AGREE_DEG:
        again = measure_fit(a, b, refined, config)
        if again.overlap >= fit.overlap - _SLACK and again.consistent >= fit.consistent - _SLACK:
            T_a_b, fit, refined_m = refined, again, moved_m
    reason = why_not_believed(fit)
    if reason:
        return Merge(None, reason, *counts, fit)
    return Merge(T_a_b, "", *counts, fit, refined_m)


def refine(a: RobotRun, b: RobotRun, T_a_b: Float64, config: MergeConfig) -> Float64:
    """Refine T_a_b (4, 4) by registration of the maps."""
    target = voxel_downsample(a.backend.surface_points(), config.voxel_m)
    source = voxel_downsample(b.backend.surface_points(), config.voxel_m)
    moved = transform_points(T_a_b, source)
    return register_clouds(moved, target, "gicp", config.cutoff_m).T_target_source @ T_a_b


def consensus(
    hypotheses: Sequence[Hypothesis], centre: Float64, agree_m: float, agree_deg: float
) -> list[Hypothesis]:
    """The largest set of hypotheses that agree with one of them.

    Two agree if they put the point ``centre`` (3,) of map b at about the same place and their
    rotations are similar.
    """
    best: list[Hypothesis] = []
    for one in hypotheses:
        agreeing = []
        for other in hypotheses:
            distance, angle = pose_difference(one.T_a_b, other.T_a_b, centre)
            if distance <= agree_m and angle <= agree_deg:
                agreeing.append(other)
        if len(agreeing) > len(best):
            best = agreeing
    return best


def pose_difference(T: Float64, T_other: Float64, point: Float64) -> tuple[float, float]:
    """Distance in metres between a point (3,) moved by two poses, and their angle in degrees."""
    moved = transform_points(T, point[None]) - transform_points(T_other, point[None])
    angle = relative_angle(T[:3, :3], T_other[:3, :3])
    return float(np.linalg.norm(moved)), float(np.degrees(angle))


def mean_pose(hypotheses: Sequence[Hypothesis], centre: Float64) -> Float64:
    """Weighted mean (4, 4) of nearby hypotheses, taken about the point ``centre`` of map b."""
    T_b_centre = np.eye(4)
    T_b_centre[:3, 3] = centre
    poses = [hypothesis.T_a_b @ T_b_centre for hypothesis in hypotheses]
    twists = [se3_log(invert(poses[0]) @ pose) for pose in poses]
    weights = [hypothesis.weight for hypothesis in hypotheses]
    return poses[0] @ se3_exp(np.average(twists, axis=0, weights=weights)) @ invert(T_b_centre)
