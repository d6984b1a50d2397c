"""Which features separate right from wrong alignments, and how well the tracker decides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import mannwhitneyu

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import Checked, bounded
from ms_slam_env.geometry import invert, make_pose, relative_angle, so3_exp
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.tables import Row, Table, finished, make_table
from ms_slam_env.sequences import HandheldPath, open_sequence
from ms_slam_env.slam.shared.alignment_check import (
    DISPUTED,
    AcceptanceThresholds,
    TrackingStatus,
    status_on_appeal,
)
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.surfel import BatchedSurfelSlam, SurfelConfig
from ms_slam_env.slam.surfel.acceptance import (
    Alignment,
    acceptance_thresholds,
    fit_of_noise,
    is_nearly_accepted,
)
from ms_slam_env.slam.surfel.submaps import FrameLookup

RIGHT_M, RIGHT_RAD = 0.02, 0.02
WRONG_M, WRONG_RAD = 0.05, 0.05
WARM_UP = 20  # frames before the first alignment, so that there is a map
AWAY_M, AWAY_DEG = 0.15, 12.0  # standard deviations of a displaced start
TRACKED, MOVED, ELSEWHERE = "tracked", "moved", "elsewhere"

FEATURES = {  # name to sign: a larger value speaks for (1) or against (-1) a pose
    "overlap": 1,
    "inlier_ratio": 1,
    "depth_conflict_ratio": -1,
    "photometric_inlier_ratio": 1,
    "cost": -1,
    "residual_m": -1,
    "sigma_m": -1,
    "degenerate_directions": -1,
}
VIEW_FEATURES = ("overlap", "inlier_ratio", "correlation")  # of frame and map's view
THRESHOLDS, APPEAL, UNCERTAIN = "thresholds", "with appeal", "uncertain too"


@dataclass(frozen=True)
class RocSpec:
    """One sequence; see :class:`AcceptanceRoc` for the fields."""

    sequence: str
    image_size: str
    frames: int
    every: int


@dataclass(frozen=True)
class AcceptanceRoc(Experiment, Checked):
    """Right and wrong alignments: what tells them apart

    The map is built by fusing every frame at its aligned pose. At regular intervals, a frame is
    aligned from the last pose and from a displaced pose, and a frame of another time from the last
    pose. The pose found is right within 2 cm and 0.02 rad of the one that follows from the true
    motion, and wrong beyond 5 cm or 0.05 rad. Features that start with "view" compare the frame
    with the map's view from the pose found.
    """

    sequences: tuple[str, ...] = (
        *(f"{scene}:3000" for scene in ("living_room", "corridor", "window", "table", "wall")),
        "carpet:3000",
        "living_room:3001:kinect+rolling-shutter",
        "living_room:3002:kinect+misregistration",
        "window:3003:kinect+auto-exposure+depth-dropout",
        "corridor:3004:kinect+motion-blur",
    )
    """Folders of recordings with truth, or scene:seed[:word[+word ...]]."""
    image_size: str = "160x120+crop"
    """Image size."""
    frames: int = bounded(200, WARM_UP + 2, 100_000)
    """Number of frames of each rendered sequence."""
    every: int = bounded(5, 1, 100_000)
    """Number of frames from one set of alignments to the next."""

    unit = "sequences"

    def specs(self) -> list[RocSpec]:
        """Every sequence."""
        return self.each(RocSpec, sequence=self.sequences)

    @staticmethod
    def run(spec: RocSpec) -> dict[str, Any]:
        """Alignments of one sequence."""
        size = spec.image_size if "/" in spec.sequence else spec.image_size.partition("+")[0]
        path = HandheldPath(frames=spec.frames)
        sequence = open_sequence(spec.sequence, size, path=path, with_truth=True)
        frames, poses = list(sequence.frames), np.stack(list(sequence.poses))
        config = SurfelConfig(refuse_bad_fits=False)
        slam = BatchedSurfelSlam(1, sequence.intrinsics, config)
        slam.reset(poses[0])
        rng = np.random.default_rng(0)
        found: list[dict[str, Any]] = []
        for index, frame in enumerate(frames):
            if index > WARM_UP and index % spec.every == 0:
                drift = slam.poses[0] @ invert(poses[index - 1])
                for kind in (TRACKED, MOVED, ELSEWHERE):
                    shown = int(rng.integers(len(frames))) if kind == ELSEWHERE else index
                    away = make_pose(
                        so3_exp(np.radians(AWAY_DEG) * rng.normal(size=3)),
                        AWAY_M * rng.normal(size=3),
                    )
                    start = slam.poses[0] @ away if kind == MOVED else slam.poses[0]
                    found.append(judge(slam, frames[shown], start, drift @ poses[shown]))
            slam.track(frame.color[None], frame.depth[None])
        return collected([one for one in found if one["is_right"] is not None])

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Outcome of each decision rule, and how well each feature separates the alignments."""
        decisions: list[dict[str, Any]] = [
            {"decision": name, **shares([row["result"] for row in finished(rows)], name)}
            for name in (THRESHOLDS, APPEAL, UNCERTAIN)
        ]
        features: list[dict[str, Any]] = []
        for name in _names():
            right, wrong = _scores(rows, name)
            if len(right) and len(wrong):
                area = float(mannwhitneyu(right, wrong).statistic / (len(right) * len(wrong)))
                refused = float((right <= np.quantile(wrong, 0.99)).mean())
                line = {"feature": name, "roc_area": area, "refused_right_at_1_percent": refused}
                features.append(line)
        features.sort(key=lambda line: -float(line["roc_area"]))
        counts = ("right_alignments", "wrong_alignments")
        return [
            make_table(("decision", *counts, "refused_right", "accepted_wrong"), decisions),
            make_table(("feature", "roc_area", "refused_right_at_1_percent"), features),
        ]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Right over wrong alignments accepted, for every threshold on a feature; decisions."""
        series = []
        for name in _names():
            right, wrong = _scores(rows, name)
            if len(right) and len(wrong):
                limits = np.quantile(np.concatenate([right, wrong]), np.linspace(0, 1, 200))
                x, y = ([float((of >= limit).mean()) for limit in limits] for of in (wrong, right))
                series.append(Series(name, x, y, mode="lines"))
        results = [row["result"] for row in finished(rows)]
        for name in (THRESHOLDS, APPEAL, UNCERTAIN):
            of = shares(results, name)
            series.append(Series(name, [of["accepted_wrong"]], [1 - of["refused_right"]]))
        caption = "Each line: limits on one feature; each point: a decision of the tracker."
        panels = [Panel("accepted_wrong", "accepted_right", series)]
        return [Chart("acceptance_roc", "Right and wrong alignments", caption, panels)]


def judge(
    slam: BatchedSurfelSlam, frame: RGBDFrame, start: Float64, truth: Float64
) -> dict[str, Any]:
    """Align a frame from ``start`` (4, 4): features, decisions, and whether ``truth`` was found."""
    lookup = FrameLookup(slam, Images(frame.color[None], frame.depth[None]))
    alignment = lookup.align_near(start)
    pose = alignment.T_world_live[0]
    away_m = np.linalg.norm(pose[:3, 3] - truth[:3, 3])
    away_rad = relative_angle(pose[:3, :3], truth[:3, :3])
    is_right = True if away_m < RIGHT_M and away_rad < RIGHT_RAD else None
    if away_m > WRONG_M or away_rad > WRONG_RAD:
        is_right = False
    view = lookup.consistency(alignment.T_world_live)
    features = {
        name: sign * float(alignment.statistics[0][name]) for name, sign in FEATURES.items()
    }
    features |= {f"view {name}": float(getattr(view, name)) for name in VIEW_FEATURES}
    status = first_status(alignment, slam.config)
    on_appeal = status
    acceptance, noise = slam.config.acceptance, fit_of_noise(1)
    if status in DISPUTED and is_nearly_accepted(alignment, 0, acceptance, noise):
        on_appeal = status_on_appeal(view)
    accepted = {
        THRESHOLDS: status == TrackingStatus.OK,
        APPEAL: on_appeal == TrackingStatus.OK,
        UNCERTAIN: on_appeal in (TrackingStatus.OK, TrackingStatus.UNCERTAIN),
    }
    return {"is_right": is_right, "features": features, "accepted": accepted}


def first_status(alignment: Alignment, config: SurfelConfig) -> TrackingStatus:
    """The status that ordinary tracking gives, ignoring the motion, as the start is displaced."""
    none = np.zeros(1, dtype=np.int32)
    limits = acceptance_thresholds(config.acceptance, none.astype(bool), none)[0]
    limits["motion_m"], limits["rotation_cos"] = np.inf, -np.inf
    return alignment.status_under(AcceptanceThresholds(*limits.tolist()), 0)


def collected(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts and scores of right and wrong alignments."""
    right, wrong = ([one for one in found if one["is_right"] == want] for want in (True, False))
    return {
        "right_alignments": len(right),
        "wrong_alignments": len(wrong),
        "decisions": [
            {
                "decision": name,
                "accepted_right_count": sum(one["accepted"][name] for one in right),
                "accepted_wrong_count": sum(one["accepted"][name] for one in wrong),
            }
            for name in (THRESHOLDS, APPEAL, UNCERTAIN)
        ],
        "features": [
            {
                "feature": name,
                "right_scores": [round(one["features"][name], 4) for one in right],
                "wrong_scores": [round(one["features"][name], 4) for one in wrong],
            }
            for name in _names()
        ],
    }


def shares(results: Sequence[Mapping[str, Any]], decision: str) -> dict[str, float]:
    """Shares of right alignments refused and wrong ones accepted, over all sequences."""
    right = sum(result["right_alignments"] for result in results)
    wrong = sum(result["wrong_alignments"] for result in results)
    own = [one for r in results for one in r["decisions"] if one["decision"] == decision]
    return {
        "right_alignments": right,
        "wrong_alignments": wrong,
        "refused_right": 1 - sum(one["accepted_right_count"] for one in own) / max(right, 1),
        "accepted_wrong": sum(one["accepted_wrong_count"] for one in own) / max(wrong, 1),
    }


def _names() -> list[str]:
    return [*FEATURES, *(f"view {name}" for name in VIEW_FEATURES)]


def _scores(rows: Sequence[Row], feature: str) -> tuple[Float64, Float64]:
    every = [one for row in finished(rows) for one in row["result"]["features"]]
    own = [one for one in every if one["feature"] == feature]
    right, wrong = (
        [v for one in own for v in one[key]] for key in ("right_scores", "wrong_scores")
    )
    return np.array(right), np.array(wrong)
