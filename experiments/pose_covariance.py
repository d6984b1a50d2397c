"""Are the covariances of the surfel SLAM's poses right? Compare predicted and true errors.

If the covariance C of the twist xi (the error) is right, xi^T C^-1 xi follows the chi-squared
distribution with six degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env import metrics, scenes, sequences, slam
from ms_slam_env import sensor as sensors
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.geometry import invert, se3_log
from ms_slam_env.metrics.consistency import COVERAGES
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.tables import Row, Table, finished, format_number, make_table

WARM_UP = 5  # frames before the first error, so that there is a map
COUNTS = ("frames", "degenerate_frames", "lost_frames")
SIZES = ("alignment_error_m", "predicted_error_m", "alignment_error_rad", "predicted_error_rad")
VALIDATION, TEST = "validation", "test"


@dataclass(frozen=True)
class CovarianceSpec:
    """One sequence; see :class:`PoseCovariance` for the fields."""

    seeds: str
    scene: str
    seed: int
    size: str
    frames: int
    noise: str
    speed_m: float
    rot_deg: float


@dataclass(frozen=True)
class PoseCovariance(Experiment, Checked):
    """Are the covariances of the surfel SLAM's poses right?

    Every frame of a rendered sequence is tracked against a map fused at the true poses, so that the
    error is that of one alignment, without drift. Then the state is reset, and the frame is fused
    at its true pose.
    """

    scenes: tuple[str, ...] = ("living_room", "table", "window", "corridor", "wall", "carpet")
    """Scenes in which to render the sequences."""
    validation_seeds: tuple[int, ...] = (1000, 1001)
    """Seeds of scenes and paths for calibrating the scale of the covariance."""
    test_seeds: tuple[int, ...] = (2000, 2001)
    """Seeds of scenes and paths for testing it."""
    size: str = "160x120"
    """Image size."""
    frames: int = bounded(60, WARM_UP + 2, 100_000)
    """Length of each sequence."""
    noise: str = "kinect"
    """Noise of the sensor."""
    speed_m: float = 0.03
    """Largest translation from frame to frame."""
    rot_deg: float = 2.0
    """Largest rotation from frame to frame."""

    unit = "sequences"

    def specs(self) -> list[CovarianceSpec]:
        """Every sequence."""
        split = {VALIDATION: self.validation_seeds, TEST: self.test_seeds}
        return [
            spec
            for seeds, numbers in split.items()
            for spec in self.each(CovarianceSpec, seeds=(seeds,), scene=self.scenes, seed=numbers)
        ]

    @staticmethod
    def run(spec: CovarianceSpec) -> dict[str, Any]:
        """Errors of one sequence."""
        scene, intrinsics = scenes.make(spec.scene, spec.seed), xtion(spec.size)
        poses = sequences.handheld_trajectory(
            scene, spec.frames, spec.seed, spec.speed_m, spec.rot_deg
        )
        sensor = sensors.RGBDSensor(scene, intrinsics, noise=spec.noise, seed=spec.seed)
        frames = [sensor.capture(pose, index) for index, pose in enumerate(poses)]
        return measure(slam.make("surfel", intrinsics), frames, list(poses))

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Shares of errors within the bounds, for all scenes together and for each."""
        results = _by_split(rows)
        groups = {f"{seeds}, all scenes": found for seeds, found in results.items()}
        groups |= {
            f"{TEST}, {scene}": [r["result"] for r in finished(rows) if _is(r, TEST, scene)]
            for scene in self.scenes
        }
        lines = [{"sequence": name, **pooled(found)} for name, found in groups.items() if found]
        factor = scale(squared_errors(results[VALIDATION]))
        note = (
            "Shares of the errors within the ellipsoids that promise 50, 90 and 95 %. Factor of "
            f"the covariances that the validation seeds ask for: {format_number(factor)}."
        )
        return [make_table(("sequence", *COUNTS, *COVERAGES, *SIZES), lines, note=note)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Share of errors found in an ellipsoid over the share that it promises."""
        promised = np.linspace(0.01, 0.99, 99)
        limits = metrics.nees_limits(promised)
        series = [Series("right", [0.0, 1.0], [0.0, 1.0], mode="lines")]
        for seeds, results in _by_split(rows).items():
            squared = squared_errors(results)
            met = [float((squared < limit).mean()) for limit in limits]
            series.append(Series(f"{seeds} seeds", promised.tolist(), met, mode="lines"))
        panel = Panel("promised_share", "found_share", series)
        caption = "Above the line: the covariance is too large."
        return [Chart("pose_covariance", "Promised and found", caption, [panel])]

    def content(self, rows: Sequence[Row]) -> Mapping[str, Any]:
        """The factor from the validation seeds, and the coverage on test seeds with it."""
        results = _by_split(rows)
        factor = scale(squared_errors(results[VALIDATION]))
        met = metrics.covariance_coverage(squared_errors(results[TEST]), factor)
        return {"validation_factor": factor, "test_coverage_with_factor": [*met.values()]}


def measure(
    backend: slam.SlamBackend, frames: Sequence[RGBDFrame], poses: Sequence[Float64]
) -> dict[str, Any]:
    """Track every frame against the map of the frames before it at their true poses (4, 4).

    An error is the twist xi, metres and radians, for which T_estimate exp(xi) is the truth.
    """
    backend.reset(poses[0])
    twists, covariances, degenerate, lost = [], [], 0, 0
    for index, (frame, truth) in enumerate(zip(frames, poses, strict=True)):
        if index >= WARM_UP:
            state = backend.get_state()
            result = backend.track(frame)
            backend.set_state(state)
            if not result.tracking_ok or result.covariance is None:
                lost += 1
            elif result.degenerate:
                degenerate += 1
            else:
                twists.append(se3_log(invert(result.T_world_camera) @ truth))
                covariances.append(result.covariance)
        backend.fuse(frame, truth)
    xi, C = np.reshape(twists, (-1, 6)), np.reshape(covariances, (-1, 6, 6))
    variances = np.diagonal(C, axis1=1, axis2=2)
    sizes = (xi[:, :3] ** 2, variances[:, :3], xi[:, 3:] ** 2, variances[:, 3:])
    return {
        "frames": len(xi),
        "degenerate_frames": degenerate,
        "lost_frames": lost,
        "squared_errors": metrics.nees(xi, C).tolist(),
        **dict(zip(SIZES, map(_rms, sizes), strict=True)),
    }


def scale(squared: Float64) -> float:
    """Factor of the covariances for which 90 % of the errors lie within the 90 % bound."""
    if not len(squared):
        return float("nan")
    return float(np.quantile(squared, 0.9) / metrics.nees_limits(0.9))


def squared_errors(results: Iterable[Mapping[str, Any]]) -> Float64:
    """Squared errors (N,) of all sequences."""
    return np.array([value for result in results for value in result["squared_errors"]])


def pooled(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts, coverage, true RMS errors and RMS of the predicted standard deviations."""
    known = [result for result in results if result["frames"]]
    frames = [result["frames"] for result in known]
    line: dict[str, Any] = {key: sum(result[key] for result in results) for key in COUNTS}
    line |= metrics.covariance_coverage(squared_errors(results))
    for key in SIZES:
        squares = [result[key] ** 2 for result in known]
        line[key] = float(np.sqrt(np.average(squares, weights=frames))) if known else None
    return line


def _rms(squares: ArrayLike) -> float:
    """Root of the mean over frames of the sum over axes of ``squares``."""
    array = np.asarray(squares)
    return float(np.sqrt(array.sum(axis=1).mean())) if len(array) else float("nan")


def _by_split(rows: Sequence[Row]) -> dict[str, list[Mapping[str, Any]]]:
    return {
        seeds: [row["result"] for row in finished(rows) if row["spec"]["seeds"] == seeds]
        for seeds in (VALIDATION, TEST)
    }


def _is(row: Mapping[str, Any], seeds: str, scene: str) -> bool:
    return bool(row["spec"]["seeds"] == seeds and row["spec"]["scene"] == scene)
