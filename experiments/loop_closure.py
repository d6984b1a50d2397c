"""Effect of loop closure on trajectory and map, on rendered recordings that return to a place.

Each is run twice, with loop closure and without.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from ms_slam_experiments.shared.loop_paths import PATHS, returning_path
from numpy.typing import NDArray

from ms_slam_env import metrics, scenes, sensor, sequences
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import xtion
from ms_slam_env.config import from_dict, nested_options
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.evaluation.loop_closures import WRONG_DEG, pose_error
from ms_slam_env.evaluation.map_quality import map_quality
from ms_slam_env.geometry import invert
from ms_slam_env.geometry.point_clouds import voxel_downsample
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.tables import Row, Table, finished, make_table, measured, summary
from ms_slam_env.slam.surfel import SurfelConfig
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam

VARIANTS = ("none", "deformation")
DEFAULT_RECORDINGS = (
    "living_room:2000:around:0.02:1.5:kinect",
    "living_room:2001:around:0.02:1.5:kinect",
    "living_room:2002:around:0.06:5:kinect",
    "living_room:2003:around:0.06:5:kinect",
    "living_room:2000:around:0.02:1.5:coarse",
    "living_room:2001:around:0.02:1.5:coarse",
    "corridor:2000:corridor:0.04:3:kinect",
    "corridor:2001:corridor:0.04:3:kinect",
    "living_room:2004:handheld:0.04:2:kinect",
    "living_room:2005:handheld:0.04:2:kinect",
)
METRICS = (
    *("ate_unaligned_m", "ate_m", "final_ate_unaligned_m", "final_ate_m", "end_error_m"),
    *("map_error_capped_rms_m", "lost_frames", "surfels", "cpu_ms_mean", "cpu_ms_max"),
    *("closed_loops", "wrong_closures"),
)
TRACKED = ("ate_tracked_m", "tracked_share")
GAPS = ("before_m", "after_m")  # between new and old map
NOISES: dict[str, str | sensor.NoiseConfig] = {
    "kinect": "kinect",
    "coarse": sensor.NoiseConfig(axial=2.0, lateral=1.5),  # multiples of a Kinect's noise
}
_WARM_UP = 5  # frames left out of the timing
WRONG_M = 0.05  # a closure is wrong if new and old map remain farther apart


@dataclass(frozen=True)
class LoopSpec:
    """One run.

    Attributes:
        scene: name of the scene, or a mesh file.
        seed: seed of the scene, the path and the noise.
        path: one of ``PATHS``.
        step_m, step_deg: largest motion between frames.
        noise: one of ``NOISES``.
        closure: variant of loop closure.
        options: parameters of SLAM.
    """

    scene: str
    seed: int
    path: str
    step_m: float
    step_deg: float
    noise: str
    size: str
    closure: str
    options: dict[str, Any] = field(default_factory=dict)

    def name(self) -> str:
        """Name of the recording."""
        pace = f"{100 * self.step_m:g} cm {self.step_deg:g} deg"
        return f"{Path(self.scene).stem}:{self.seed} {self.path}, {pace}, {self.noise}"


@dataclass(frozen=True)
class LoopClosure(Experiment):
    """Recordings that come back to their start, with loop closure and without

    When the camera sees a part again that has drifted away, loop closure deforms the map so that
    both parts coincide.
    """

    recordings: tuple[str, ...] = DEFAULT_RECORDINGS
    """scene:seed:path:step_m:step_deg:noise for each; the scene may be a mesh file."""
    sizes: tuple[str, ...] = ("160x120", "320x240")
    """Image sizes."""
    options: tuple[str, ...] = ()
    """Parameters of SLAM, as in loops.window=100."""

    unit = "recordings"

    @staticmethod
    def run(spec: LoopSpec) -> dict[str, Any]:
        """Run SLAM on one recording."""
        scene = scenes.make(spec.scene, spec.seed)
        truth = returning_path(scene, spec.path, spec.seed, spec.step_m, spec.step_deg)
        camera = xtion(spec.size)
        sequence = sequences.render_sequence(scene, truth, camera, NOISES[spec.noise], spec.seed)
        options = from_dict(SurfelConfig, spec.options, "options")
        config = replace(options, loop_closure=spec.closure)
        system = BatchedSurfelSlam(1, camera, config)
        system.reset(truth[0])
        estimate, spent, tracked = np.empty_like(truth), [], []
        closures: list[Closure] = []
        for k, frame in enumerate(sequence.frames):
            past = system.loops.trajectory(0)
            previous = system.poses[0].copy()
            start = time.process_time()
            result = system.track(frame.color[None], frame.depth[None])[0]
            spent.append(1000 * (time.process_time() - start))
            estimate[k] = result.T_world_camera
            tracked.append(result.tracking_ok)
            if result.loop_closed:
                # Without the closure, the pose would have followed the true motion.
                unclosed = previous @ invert(truth[k - 1]) @ truth[k]
                window = config.loops.window
                closures.append(judge_closure(k, past, truth, unclosed, estimate[k], window))
        frames, bent = system.loops.trajectory(0)
        final = estimate.copy()
        final[frames] = bent
        surface = voxel_downsample(scene.surface_points(0.01)[0], 0.01)
        error_m = np.linalg.norm(estimate[:, :3, 3] - truth[:, :3, 3], axis=1)
        return {
            "frames": len(truth),
            "path_m": metrics.path_length(truth),
            "ate_unaligned_m": metrics.ate_rmse(estimate, truth, align="none"),
            "ate_m": metrics.ate_rmse(estimate, truth),
            **metrics.tracked_errors(estimate, truth, tracked),
            "final_ate_unaligned_m": metrics.ate_rmse(final, truth, align="none"),
            "final_ate_m": metrics.ate_rmse(final, truth),
            "end_error_m": float(error_m[-1]),
            "largest_error_m": float(error_m.max()),
            **map_quality(system.map.points(stable=False), surface, ("map_error_capped_rms_m",)),
            "lost_frames": tracked.count(False),
            "closed_loops": len(closures),
            "closures": [asdict(closure) for closure in closures],
            "wrong_closures": sum(closure.is_wrong for closure in closures),
            "cpu_ms_mean": float(np.mean(spent[_WARM_UP:])),
            "cpu_ms_median": float(np.median(spent[_WARM_UP:])),
            "cpu_ms_max": float(np.max(spent[_WARM_UP:])),
            "surfels": system.map.count(),
        }

    def specs(self) -> list[LoopSpec]:
        """Every run."""
        options = nested_options(self.options)
        from_dict(SurfelConfig, options, "options")  # refuse invalid ones before any run
        return [
            LoopSpec(*_parse(text), size, closure, options)
            for size in self.sizes
            for text in self.recordings
            for closure in VARIANTS
        ]

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per run, and medians over the recordings that both variants finished."""
        lines: list[dict[str, Any]] = [
            {"sequence": LoopSpec(**row["spec"]).name(), "image_size": row["spec"]["size"],
             "loop_closure": row["spec"]["closure"], **_medians(row["result"]["closures"], GAPS),
             **{key: row["result"].get(key) for key in (*METRICS, *TRACKED)}}
            for row in finished(rows)
        ]  # fmt: skip
        shown = (*METRICS, *measured(TRACKED, rows), *GAPS)
        columns = ["sequence", "image_size", "loop_closure", *shown]
        pairs = pairs_of(rows)
        medians: list[dict[str, Any]] = [
            {"loop_closure": variant, "recordings": len(pairs),
             **_medians([p[variant] for p in pairs], METRICS)}
            for variant in VARIANTS
        ]  # fmt: skip
        wins = {key: sum(p["deformation"][key] < p["none"][key] for p in pairs) for key in METRICS}
        note = "Medians over the recordings that both variants finished. Lower with loop closure: "
        lower = [f"{metric(key).heading} {n} of {len(pairs)}" for key, n in wins.items()]
        note += ", ".join(lower) + "."
        first = make_table(["loop_closure", "recordings", *METRICS], medians, "Medians", note)
        return [first, make_table(columns, lines, "Every recording")]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Error with loop closure against error without."""
        pairs = pairs_of(rows)
        numbers, panels = list(range(1, len(pairs) + 1)), []
        for key in ("ate_m", "map_error_capped_rms_m"):
            values = {name: [pair[name][key] for pair in pairs] for name in VARIANTS}
            marks = [Series(name, numbers, y, mode="markers") for name, y in values.items()]
            panels.append(Panel("recordings", key, marks))
        return [Chart("loop_closure", "Error by recording", "One mark a run.", panels)]


def pairs_of(rows: Sequence[Row]) -> list[dict[str, Row]]:
    """Results by variant, for the recordings that both variants finished."""
    results: dict[str, dict[str, Row]] = {}
    for row in finished(rows):
        spec = LoopSpec(**row["spec"])
        results.setdefault(f"{spec.name()}, {spec.size}", {})[spec.closure] = row["result"]
    return [pair for pair in results.values() if len(pair) == len(VARIANTS)]


def _medians(results: Iterable[Row], keys: Sequence[str]) -> dict[str, float]:
    results = list(results)
    return {key: summary(results, key).value for key in keys}


def _parse(text: str) -> tuple[str, int, str, float, float, str]:
    """Parts of a recording's name.

    Raises:
        InputError: wrong number of parts, invalid numbers, an unknown path or noise.
    """
    parts = text.rsplit(":", 5)
    if len(parts) != 6:
        raise InputError(f"recording {text!r} must be scene:seed:path:step_m:step_deg:noise")
    scene, seed, path, step_m, step_deg, noise = parts
    for kind, value, choices in (("path", path, PATHS), ("noise", noise, tuple(NOISES))):
        if value not in choices:
            raise unknown(kind, value, choices)
    try:
        return scene, int(seed), path, float(step_m), float(step_deg), noise
    except ValueError:
        raise InputError(f"recording {text!r}: seed and steps must be numbers") from None


@dataclass(frozen=True)
class Closure:
    """One loop closure: distances between new and old map before and after, and the frame."""

    frame: int
    before_m: float
    before_deg: float
    after_m: float
    after_deg: float

    @property
    def is_wrong(self) -> bool:
        """Whether new and old map do not fit afterwards."""
        return self.after_m > WRONG_M or self.after_deg > WRONG_DEG


def judge_closure(
    frame: int,
    past: tuple[NDArray[np.int32], Float64],
    truth: Float64,
    unclosed: Float64,
    closed: Float64,
    window: int,
) -> Closure:
    """Compare the poses before and after a closure with the pose that the old map implies.

    That pose is the true motion from the nearest old frame, applied to that frame's estimate.
    """
    frames, poses = past
    old = frames < frame - window
    frames, poses = frames[old], poses[old]
    motions = invert(truth[frames]) @ truth[frame]
    cosines = np.clip((np.trace(motions[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)
    nearest = int((np.linalg.norm(motions[:, :3, 3], axis=1) + np.arccos(cosines)).argmin())
    ideal = poses[nearest] @ motions[nearest]
    return Closure(frame, *pose_error(ideal, unclosed), *pose_error(ideal, closed))
