"""Are the covariances of the surfel SLAM's poses right? Predicted against true errors.

Every frame of a rendered sequence is tracked against a map that was fused at the true poses, so
the error is that of one alignment and drift has no part in it; the state is then set back and the
frame fused at its true pose. If the covariance C of the twist xi (the error) is right, xi^T C^-1 xi
follows the chi-squared distribution with six degrees of freedom. Run as
``ms-slam experiment pose-covariance --out DIR``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from tqdm import tqdm

from ms_slam_env import slam
from ms_slam_env.benchmark.figures import caption, colour, new_figure, save
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.config import check_range
from ms_slam_env.geometry import invert, se3_log
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.report.tables import markdown_table
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import handheld_trajectory

Float64 = NDArray[np.float64]

PROGRAM = "ms-slam experiment pose-covariance"
DEGREES_OF_FREEDOM = 6
BOUNDS = (0.5, 0.9, 0.95)
WARM_UP = 5  # frames before the first error, so that there is a map


@dataclass(frozen=True)
class PoseCovarianceConfig:
    """Are the covariances of the surfel SLAM's poses right?

    Attributes:
        out: folder for the results.
        scenes: where the sequences are rendered.
        validation_seeds: of scenes and paths from which the scale of the covariance comes.
        test_seeds: of those on which it is judged.
        size: of the images.
        frames: length of each sequence.
        noise: of the sensor.
        speed_m: largest translation from frame to frame.
        rot_deg: largest rotation from frame to frame.

    Raises:
        InputError: a value out of range.
    """

    out: Path
    scenes: tuple[str, ...] = ("living_room", "table", "window", "corridor", "wall", "carpet")
    validation_seeds: tuple[int, ...] = (1000, 1001)
    test_seeds: tuple[int, ...] = (2000, 2001)
    size: str = "160x120"
    frames: int = 60
    noise: str = "kinect"
    speed_m: float = 0.03
    rot_deg: float = 2.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "frames", WARM_UP + 2, 100_000)


@dataclass(frozen=True)
class Errors:
    """Errors of one sequence's alignments and what was predicted of them.

    Attributes:
        twists: (N, 6) errors xi in metres and radians; T_estimate exp(xi) is the truth.
        covariances: (N, 6, 6).
        degenerate: frames left out because the view left a direction open.
        lost: frames left out because they were not tracked.
    """

    twists: Float64
    covariances: Float64
    degenerate: int
    lost: int

    @property
    def squared(self) -> Float64:
        """(N,) xi^T C^-1 xi."""
        if not len(self.twists):
            return np.zeros(0)
        solved = np.linalg.solve(self.covariances, self.twists[..., None])[..., 0]
        return np.asarray((self.twists * solved).sum(axis=1))


def measure(
    backend: slam.SlamBackend, frames: Sequence[RGBDFrame], poses: Sequence[Float64]
) -> Errors:
    """Track every frame against the map of the true poses before it."""
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
    return Errors(
        np.reshape(twists, (-1, 6)), np.reshape(covariances, (-1, 6, 6)), degenerate, lost
    )


def coverage(squared: Float64, factor: float = 1.0) -> list[float]:
    """Share of errors within the ellipsoids of ``BOUNDS``, covariances times ``factor``."""
    limits = factor * chi2.ppf(BOUNDS, DEGREES_OF_FREEDOM)
    return [float((squared < limit).mean()) if len(squared) else np.nan for limit in limits]


def scale(squared: Float64) -> float:
    """Factor of the covariances with which nine tenths of the errors are within that bound."""
    return float(np.quantile(squared, 0.9) / chi2.ppf(0.9, DEGREES_OF_FREEDOM))


def run(config: PoseCovarianceConfig) -> dict[str, Any]:
    """Measure all sequences; the factor comes from the validation seeds alone.

    Raises:
        InputError: unknown scene, size or noise.
    """
    intrinsics = xtion(config.size)
    backend = slam.make("surfel", intrinsics)
    errors: dict[str, dict[str, list[Errors]]] = {"validation": {}, "test": {}}
    split_seeds = {"validation": config.validation_seeds, "test": config.test_seeds}
    work = [
        (s, n, seed) for s, seeds in split_seeds.items() for n in config.scenes for seed in seeds
    ]
    for split, name, seed in tqdm(work, desc="sequences", file=sys.stderr):
        scene = get_scene(name, seed)
        poses = handheld_trajectory(scene, config.frames, seed, config.speed_m, config.rot_deg)
        sensor = RGBDSensor(scene, intrinsics, noise=config.noise, seed=seed)
        frames = [sensor.capture(pose, index) for index, pose in enumerate(poses)]
        errors[split].setdefault(name, []).append(measure(backend, frames, list(poses)))
    pooled = {split: _join(found, found) for split, found in errors.items()}
    factor = scale(pooled["validation"].squared)
    rows = [_row("validation, all scenes", pooled["validation"])]
    rows += [_row("test, all scenes", pooled["test"])]
    rows += [_row(f"test, {name}", _join(errors["test"], [name])) for name in config.scenes]
    report = {
        "provenance": provenance(),
        "config": {key: str(value) for key, value in asdict(config).items()},
        "validation_factor": factor,
        "test_coverage_with_factor": coverage(pooled["test"].squared, factor),
        "rows": rows,
    }
    config.out.mkdir(parents=True, exist_ok=True)
    write_json(config.out / "pose_covariance.json", report)
    (config.out / "pose_covariance.md").write_text(as_markdown(report), encoding="utf-8")
    save_reliability(pooled, config.out / "pose_covariance.png")
    return report


def _join(errors: dict[str, list[Errors]], names: Sequence[str] | dict[str, Any]) -> Errors:
    parts = [part for name in names for part in errors[name]]
    return Errors(
        np.concatenate([part.twists for part in parts]),
        np.concatenate([part.covariances for part in parts]),
        sum(part.degenerate for part in parts),
        sum(part.lost for part in parts),
    )


def _row(name: str, errors: Errors) -> dict[str, Any]:
    """Coverage, true RMS errors and RMS of the predicted standard deviations."""
    variances = np.diagonal(errors.covariances, axis1=1, axis2=2)
    return {
        "sequences": name,
        "frames": len(errors.twists),
        "degenerate": errors.degenerate,
        "lost": errors.lost,
        "coverage": coverage(errors.squared),
        "error_mm": _rms(errors.twists[:, :3] ** 2) * 1e3,
        "predicted_mm": _rms(variances[:, :3]) * 1e3,
        "error_mrad": _rms(errors.twists[:, 3:] ** 2) * 1e3,
        "predicted_mrad": _rms(variances[:, 3:]) * 1e3,
    }


def _rms(squares: Float64) -> float:
    """Root of the mean over frames of the sum over axes."""
    return float(np.sqrt(squares.sum(axis=1).mean())) if len(squares) else float("nan")


def as_markdown(report: dict[str, Any]) -> str:
    """Table of the shares within the bounds."""
    header = ["sequences", "frames", "degenerate", "lost"]
    header += [f"within {100 * bound:.0f} %" for bound in BOUNDS]
    header += ["error mm", "predicted mm", "error mrad", "predicted mrad"]
    body = []
    for row in report["rows"]:
        cells = [row["sequences"], *(str(row[key]) for key in ("frames", "degenerate", "lost"))]
        cells += [f"{100 * share:.0f} %" for share in row["coverage"]]
        keys = ("error_mm", "predicted_mm", "error_mrad", "predicted_mrad")
        body.append(cells + [f"{row[key]:.2f}" for key in keys])
    table = markdown_table(header, body)
    return (
        f"{table}\nFactor that the validation seeds ask for: {report['validation_factor']:.2f}.\n"
    )


def save_reliability(pooled: dict[str, Errors], path: Path) -> Path:
    """Draw the share of errors within an ellipsoid over the share that it promises."""
    promised = np.linspace(0.01, 0.99, 99)
    limits = chi2.ppf(promised, DEGREES_OF_FREEDOM)
    figure = new_figure()
    ax = figure.axes[0] if figure.axes else figure.add_subplot()
    ax.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="right")
    for index, (split, errors) in enumerate(pooled.items()):
        met = [(errors.squared < limit).mean() for limit in limits]
        ax.plot(promised, met, color=colour(index), label=f"{split} seeds")
    ax.set_xlabel("promised share of errors inside")
    ax.set_ylabel("share found inside")
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1)
    ax.legend(frameon=False)
    caption(figure, "above the line: the covariance is too large")
    return save(figure, path)


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark and print its table; return the exit code."""
    config = parse(PoseCovarianceConfig, arguments, PROGRAM)
    run(config)
    print((config.out / "pose_covariance.md").read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
