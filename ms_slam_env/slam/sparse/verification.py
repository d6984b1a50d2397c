"""Whether a pose is to be believed."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert
from ms_slam_env.slam.alignment_check import (
    NO_ALIGNMENT,
    VIEW_REASONS,
    AcceptanceThresholds,
    AlignmentStatistics,
    evaluate_alignment,
    measure_alignment,
)
from ms_slam_env.slam.sparse.config import SparseConfig
from ms_slam_env.slam.sparse.localisation import Fix, LiveFrame
from ms_slam_env.slam.sparse.sparse_map import SparseMap

_SAMPLES = 1000  # readings that a pose is judged by
_LEAST_EXPLAINED = 0.25  # share of the matches


@dataclass(frozen=True)
class Verdict:
    """What an image says about a pose.

    Attributes:
        statistics: of the alignment with the keyframe beside it.
        reason: why the pose is not believed; empty if it is.
    """

    statistics: AlignmentStatistics
    reason: str


class Verifier:
    """Judges poses by their matches, and by the depth and intensity of the keyframe beside them.

    Args:
        sparse_map: keyframes.
        config: parameters.
    """

    def __init__(self, sparse_map: SparseMap, config: SparseConfig) -> None:
        self._map = sparse_map
        self._least = config.least_matches
        self._intrinsics: Intrinsics = sparse_map.intrinsics
        self._thresholds = AcceptanceThresholds(
            overlap=config.least_overlap,
            inlier_ratio=config.least_inliers,
            photometric_inlier_ratio=config.least_alike,
        )

    def judge(self, fix: Fix, frame: LiveFrame) -> Verdict:
        """Compare a frame with the map at the pose found."""
        explained = len(fix.point_ids)
        if explained < self._least:
            reason = f"only {explained} corners match the map, of {self._least} needed"
            return Verdict(NO_ALIGNMENT, reason)
        if explained < _LEAST_EXPLAINED * fix.matches:
            reason = f"only {explained} of {fix.matches} matching corners fit one pose"
            return Verdict(NO_ALIGNMENT, reason)
        keyframe = self._map.keyframes[fix.reference]
        motion = invert(keyframe.T_world_camera) @ fix.T_world_camera
        statistics = measure_alignment(
            frame.image, keyframe.image(), motion, self._intrinsics, _SAMPLES
        )
        return Verdict(statistics, VIEW_REASONS[evaluate_alignment(statistics, self._thresholds)])
