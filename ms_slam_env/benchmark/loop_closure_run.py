"""One recording with a loop through the SLAM, with or without loop closure."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import scenes
from ms_slam_env.benchmark.loop_closure_figure import MapView, save_picture
from ms_slam_env.benchmark.loop_paths import along_corridor, around_room
from ms_slam_env.camera import xtion
from ms_slam_env.config import from_dict
from ms_slam_env.errors import unknown
from ms_slam_env.geometry import invert, relative_angle
from ms_slam_env.metrics import ate_rmse, path_length
from ms_slam_env.metrics.reconstruction import nearest_distances, voxel_thin
from ms_slam_env.scenes import Scene
from ms_slam_env.sensor import NoiseConfig
from ms_slam_env.sequences import HandheldPath, render_sequence
from ms_slam_env.slam.surfel import SurfelConfig
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam

Float64 = NDArray[np.float64]

NOISES: dict[str, str | NoiseConfig] = {
    "kinect": "kinect",
    "coarse": NoiseConfig(axial=2.0, lateral=1.5),
}
"""``coarse``: twice the axial and 1.5 times the lateral noise of a Kinect."""
PATHS = ("around", "corridor", "handheld")
HANDHELD_FRAMES = 600
WRONG_M, WRONG_DEG = 0.05, 3.0
"""A closure is wrong if it leaves new and old map further apart than this."""
_WARM_UP = 5  # frames left out of the timing


@dataclass(frozen=True)
class LoopSpec:
    """One run.

    Attributes:
        scene: name of the scene, or a mesh file.
        seed: of the scene, the path and the noise.
        path: one of ``PATHS``.
        step_m: largest translation between frames.
        step_deg: largest rotation between frames.
        noise: one of ``NOISES``.
        size: of the images.
        closure: variant of loop closure.
        options: parameters of the SLAM.
        picture: where a picture of the first closure goes; empty for none.
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
    picture: str = ""

    def name(self) -> str:
        """Of the recording."""
        pace = f"{100 * self.step_m:g} cm {self.step_deg:g} deg"
        return f"{Path(self.scene).stem}:{self.seed} {self.path}, {pace}, {self.noise}"


def camera_path(scene: Scene, spec: LoopSpec) -> Float64:
    """Poses (N, 4, 4) of the recording.

    Raises:
        InputError: an unknown path, or none in this scene.
    """
    if spec.path == "around":
        return around_room(scene, spec.seed, spec.step_m, spec.step_deg)
    if spec.path == "corridor":
        return along_corridor(scene, spec.seed, spec.step_m, spec.step_deg)
    if spec.path == "handheld":
        pace = HandheldPath(
            frames=HANDHELD_FRAMES, max_step_m=spec.step_m, max_turn_deg=spec.step_deg, loop=True
        )
        return pace.poses(scene, spec.seed)
    raise unknown("path", spec.path, PATHS)


@dataclass(frozen=True)
class Closure:
    """One closed loop: how far new and old map were apart before and after, and when."""

    frame: int
    before_m: float
    before_deg: float
    after_m: float
    after_deg: float

    @property
    def is_wrong(self) -> bool:
        """Whether they do not fit after it."""
        return self.after_m > WRONG_M or self.after_deg > WRONG_DEG


def run_loop(spec: LoopSpec) -> dict[str, Any]:
    """Run one recording; errors in metres, processor time in milliseconds."""
    scene = scenes.make(spec.scene, spec.seed)
    truth = camera_path(scene, spec)
    camera = xtion(spec.size)
    sequence = render_sequence(scene, truth, camera, NOISES[spec.noise], spec.seed)
    config = from_dict(SurfelConfig, spec.options, "options")
    config = replace(config, loop_closure=spec.closure)
    system = BatchedSurfelSlam(1, camera, config)
    system.reset(truth[0])
    estimate, spent, lost = np.empty_like(truth), [], 0
    closures: list[Closure] = []
    views: tuple[MapView, MapView] | None = None
    for k, frame in enumerate(sequence.frames):
        past = system.loops.trajectory(0)
        is_due = bool(spec.picture) and not views and k % config.loops.interval == 0
        before = _map_view(system, k) if is_due else None
        previous = system.poses[0].copy()
        start = time.process_time()
        result = system.track(frame.color[None], frame.depth[None])[0]
        spent.append(1000 * (time.process_time() - start))
        estimate[k] = result.T_world_camera
        lost += not result.tracking_ok
        if result.loop_closed:
            # Without the closure the camera had gone on as it truly did.
            unclosed = previous @ invert(truth[k - 1]) @ truth[k]
            closures.append(_judge(k, past, truth, unclosed, estimate[k], config.loops.window))
            if before is not None:
                views = (before, _map_view(system, k))
    if views:
        save_picture(views, scene, truth[closures[0].frame], Path(spec.picture), spec.name())
    frames, bent = system.loops.trajectory(0)
    final = estimate.copy()
    final[frames] = bent
    surface = voxel_thin(scene.surface_points(0.01)[0], 0.01)
    errors = nearest_distances(voxel_thin(system.map.points(stable=False), 0.01), surface)
    error_m = np.linalg.norm(estimate[:, :3, 3] - truth[:, :3, 3], axis=1)
    return {
        "frames": len(truth),
        "path_m": path_length(truth),
        "ate_m": ate_rmse(estimate, truth, align="none"),
        "ate_aligned_m": ate_rmse(estimate, truth),
        "final_ate_m": ate_rmse(final, truth, align="none"),
        "final_ate_aligned_m": ate_rmse(final, truth),
        "end_m": float(error_m[-1]),
        "largest_m": float(error_m.max()),
        "map_error_m": float(np.sqrt(np.mean(np.minimum(errors, 0.1) ** 2))),
        "lost": lost,
        "closures": [asdict(closure) for closure in closures],
        "wrong": sum(closure.is_wrong for closure in closures),
        "frame_ms": float(np.mean(spent[_WARM_UP:])),
        "median_ms": float(np.median(spent[_WARM_UP:])),
        "longest_ms": float(np.max(spent[_WARM_UP:])),
        "surfels": system.map.count(),
    }


def _judge(
    frame: int,
    past: tuple[NDArray[np.int32], Float64],
    truth: Float64,
    unclosed: Float64,
    closed: Float64,
    window: int,
) -> Closure:
    """Compare the poses before and after a closure with where the old map says the camera is.

    That is the true motion from the nearest old frame, applied to its estimate.
    """
    frames, poses = past
    old = frames < frame - window
    frames, poses = frames[old], poses[old]
    motions = invert(truth[frames]) @ truth[frame]
    cosines = np.clip((np.trace(motions[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)
    nearest = int((np.linalg.norm(motions[:, :3, 3], axis=1) + np.arccos(cosines)).argmin())
    ideal = poses[nearest] @ motions[nearest]
    return Closure(frame, *_apart(ideal, unclosed), *_apart(ideal, closed))


def _apart(a: Float64, b: Float64) -> tuple[float, float]:
    distance = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    return distance, float(np.degrees(relative_angle(a[:3, :3], b[:3, :3])))


def _map_view(system: BatchedSurfelSlam, frame: int) -> MapView:
    surfel_map = system.map
    points = surfel_map.points(stable=False)
    created = surfel_map.attribute("created", stable=False)
    return MapView(points, (frame - created).astype(np.int32))
