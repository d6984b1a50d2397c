"""One SLAM backend on one USME sequence, by all of USME's measures, in a process of its own.

``python -m ms_slam_env.benchmark.usme_run`` reads a specification as JSON from its input and writes
what it measured as JSON to its output, as ``compare_run`` does.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.benchmark.compare_run import WARM_UP, run_module
from ms_slam_env.errors import InputError
from ms_slam_env.parallel import limit_threads

if TYPE_CHECKING:
    from ms_slam_env.camera import RGBDFrame
    from ms_slam_env.evaluation.run_sequence import SequenceRun
    from ms_slam_env.scenes import Scene
    from ms_slam_env.sequences import RenderedSequence

Float64 = NDArray[np.float64]

_NAME = "usme_run"
_VIEW_EVERY_M = 1.5  # along the true path, for the true surface
_VIEW_SIZE = "320x240"
_MOST_VIEWS = 150
_MOST_POINTS = 1_000_000


@dataclass(frozen=True)
class UsmeSpec:
    """A backend on a sequence.

    Attributes:
        sequence: its name in the suite.
        backend: its name.
        image_size: such as 160x120.
        seed: of scene, way, noise and perturbations.
        params: of the backend, beside those that the scene needs.
        frames_scale: share of the frames that the same way takes.
        folder: of the rendered sequence; None renders the frames as they are needed.
        threads: cores that the backend may use.
    """

    sequence: str
    backend: str
    image_size: str = "160x120"
    seed: int = 2000
    params: dict[str, Any] = field(default_factory=dict)
    frames_scale: float = 1.0
    folder: str | None = None
    threads: int = 1


def run_apart(spec: UsmeSpec) -> dict[str, Any]:
    """Run ``spec`` in a new process and return what ``run_here`` measured there."""
    return run_module(_NAME, asdict(spec), spec.threads)


def run_here(spec: UsmeSpec) -> dict[str, Any]:
    """Track the sequence from its true first pose and measure.

    Returns:
        flat names, None where a measure does not apply or cannot be had. Length: ``frames``,
        ``duration_s``, ``path_m``. Accuracy: ``ate_m``, ``ate_max_m`` (SE(3)-aligned, USME 1-2),
        ``end_error_m`` (of the last pose, not aligned), ``drift`` (that over the path), ``rpe_m``
        and ``rpe_rad`` (frame to frame, 3-5), ``ate_corrected_m`` (of the finished map's poses).
        Map, after outlier removal (6) and ICP: ``c2c_mean_m``, ``c2c_std_m``, ``hausdorff_m`` (7,
        directed: what the map has too much), ``completion`` (share of the true surface within
        ``near_m``), ``noise_ratio`` (8), ``points``, ``spacing_m`` (sparsity). Robustness:
        ``lost``, ``robustness`` (9-10), ``relocalisation_s`` (11, infinite = never). Start:
        ``initialisation_s`` and ``scale_error`` (12-13). Cost: all of ``CostMeter.summary``.
    """
    from ms_slam_env import metrics, scenes, slam
    from ms_slam_env.benchmark import usme_suite
    from ms_slam_env.evaluation.run_sequence import run_sequence

    entry = usme_suite.find(spec.sequence)
    scene = scenes.make(entry.scene, spec.seed)
    sequence = usme_suite.render(entry, scene, spec.image_size, spec.frames_scale)
    options = {**usme_suite.slam_options(entry.scene, spec.backend), **spec.params}
    costs = metrics.CostMeter(str(options.get("device", "cpu")))
    system = slam.make(spec.backend, sequence.intrinsics, **options)
    black: list[bool] = []
    run = run_sequence(
        system,
        _frames(sequence, spec.folder),
        start=sequence.poses[0],
        meter=costs,
        on_step=lambda step: black.append(not step.frame.color.any()),
    )
    poses, truth = run.estimates, sequence.poses
    tracked, seconds = run.tracking_ok, np.array(run.timestamps)
    ate = metrics.ate_statistics(poses, truth)
    start = metrics.initialisation(seconds, poses, truth, global_scale=1.0)
    end_error = float(np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3]))
    path = metrics.path_length(truth)
    return {
        "frames": len(poses),
        "duration_s": float(seconds[-1] - seconds[0]),
        "path_m": path,
        "ate_m": ate.rmse,
        "ate_max_m": ate.max,
        "end_error_m": end_error,
        "drift": end_error / path,
        "rpe_m": metrics.rpe_rmse(poses, truth),
        "rpe_rad": metrics.rpe_rmse(poses, truth, kind="rotation"),
        "ate_corrected_m": _corrected_ate(run, truth),
        "lost": run.lost,
        "robustness": _robustness(poses, truth, tracked),
        "relocalisation_s": _relocalisation(seconds, np.array(black), tracked),
        "initialisation_s": start.time_s,
        "scale_error": start.scale_error,
        **costs.summary(skip=min(WARM_UP, len(poses) - 1)),
        **map_measures(
            system.surface_points(), _seen_surface(scene, sequence.poses, options), entry.scene
        ),
    }


def _frames(sequence: RenderedSequence, folder: str | None) -> Iterator[RGBDFrame]:
    """The frames, from a folder if there is one.

    Raises:
        InputError: the folder holds another number of frames than the sequence has.
    """
    if folder is None:
        yield from sequence.frames
        return
    from ms_slam_env.sequences.recording import open_recording

    recording = open_recording(Path(folder))
    if len(recording) != len(sequence):
        raise InputError(
            f"{folder} holds {len(recording)} frames, but the sequence has {len(sequence)}"
        )
    yield from recording


def _corrected_ate(run: SequenceRun, truth: Float64) -> float | None:
    from ms_slam_env import metrics

    corrected = run.corrected()
    return None if corrected is None else metrics.ate_rmse(corrected, truth)


def _robustness(poses: Float64, truth: Float64, tracked: NDArray[np.bool_]) -> float | None:
    from ms_slam_env import metrics

    if not len(metrics.tracked_segments(tracked)):
        return None
    return metrics.tracking_robustness(poses, truth, tracked).error


def _relocalisation(
    times: Float64, black: NDArray[np.bool_], tracked: NDArray[np.bool_]
) -> float | None:
    from ms_slam_env import metrics

    value = metrics.mean_relocalisation_time(times, black, tracked)
    return None if np.isnan(value) else value


def _seen_surface(scene: Scene, poses: Float64, options: dict[str, Any]) -> Float64:
    """True surface (M, 3) that the camera saw within the reach of SLAM, moving objects left out."""
    from ms_slam_env import metrics
    from ms_slam_env.camera import xtion
    from ms_slam_env.sensor import RGBDSensor

    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    walked = np.concatenate([[0.0], np.cumsum(steps)])
    count = int(min(_MOST_VIEWS, max(20, walked[-1] / _VIEW_EVERY_M)))
    picked = np.searchsorted(walked, np.linspace(0.0, walked[-1], count))
    sensor = RGBDSensor(scene, xtion(_VIEW_SIZE), noise="none")
    reach = float(options.get("depth_cutoff_m", 4.0))
    clouds = []
    for index in np.unique(picked):
        view = sensor.ground_truth(poses[index])
        near = (view.depth > 0) & (view.depth <= reach)
        clouds.append(
            metrics.voxel_downsample(view.points[near].astype(np.float64), voxel_m(scene.name))
        )
    return metrics.voxel_downsample(np.concatenate(clouds), voxel_m(scene.name))


def voxel_m(scene: str) -> float:
    """Edge of the voxels in which clouds keep one point: by them a surface counts by its area."""
    from ms_slam_env.scenes import LARGE_SCENES

    return 0.05 if scene in LARGE_SCENES else 0.01


def map_measures(points: Float64, surface: Float64, scene: str) -> dict[str, Any]:
    """Measures of the map (N, 3) against the true surface (M, 3); see ``run_here``."""
    from ms_slam_env import metrics
    from ms_slam_env.evaluation.map_quality import ComparedMap
    from ms_slam_env.geometry import transform_points

    near = 5 * voxel_m(scene)
    nothing = dict.fromkeys(
        ("c2c_mean_m", "c2c_std_m", "hausdorff_m", "completion", "noise_ratio", "spacing_m")
    )
    result: dict[str, Any] = {"points": len(points), "near_m": near, **nothing}
    cloud = metrics.voxel_downsample(points, voxel_m(scene)) if len(points) else points
    if len(cloud) < 100:
        return result
    if len(cloud) > _MOST_POINTS:
        cloud = cloud[np.linspace(0, len(cloud) - 1, _MOST_POINTS).astype(np.int64)]
    inliers = metrics.statistical_inliers(cloud)
    result["noise_ratio"] = 1.0 - float(inliers.mean())
    result["spacing_m"] = metrics.point_spacing(cloud)
    kept = cloud[inliers]
    found = metrics.register_clouds(kept, surface, "icp", cutoff_m=10 * near)
    placed = ComparedMap(transform_points(found.T_target_source, kept), surface, voxel_m=0)
    return {
        **result,
        **placed.measure(("c2c_mean_m", "c2c_std_m")),
        "hausdorff_m": float(placed.to_surface.max()),
        "completion": placed.recall(near),
    }


def main() -> int:
    """Run the specification on the input."""
    spec = UsmeSpec(**json.load(sys.stdin))
    limit_threads(spec.threads)
    print(json.dumps(run_here(spec)))
    return 0


if __name__ == "__main__":
    from ms_slam_env.command_line import exit_code

    sys.exit(exit_code(main, _NAME))
