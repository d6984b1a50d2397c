"""Show an episode in the Rerun viewer: images, map, paths, and the reasons for each motion."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ms_slam_env._runtime.output_files import write_bytes
from ms_slam_env.env.planners import Planner, goal_of
from ms_slam_env.env.third_person_view import ESTIMATE_COLOR, TRUE_COLOR, arm_dots
from ms_slam_env.errors import InputError
from ms_slam_env.robot import describe

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv


APPLICATION = "ms_slam_env"
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_MOST_POINTS = 40_000  # map points sent per step; a viewer keeps every step
_SURFEL_M = 0.012
_SUBMAPS = np.array(
    [(31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (140, 86, 75)],
    dtype=np.uint8,
)


class EpisodeView:
    """Sends an episode to a viewer, step by step.

    Entities: ``world/camera`` (true, with the images) and ``world/estimate``, ``world/path`` of
    both, ``world/map`` (in the colours of its submaps where there are several), ``world/arm``,
    ``world/candidates`` with their predicted divergences, if these were computed, ``world/goal`` of
    the planner, and over time ``divergence``, ``reward``, ``error`` and ``mapped``.

    Args:
        env: the unwrapped environment.
        path: file (.rrd) to write to; None: open a viewer.

    Raises:
        InputError: Rerun is not installed, or its viewer cannot be opened.
    """

    def __init__(self, env: ActiveSlamEnv, path: Path | None = None) -> None:
        try:
            import rerun
        except ImportError:
            raise InputError("the viewer needs Rerun: pip install 'ms-slam-env[view]'") from None
        if path is None and sys.platform == "linux" and not any(map(os.environ.get, _DISPLAYS)):
            raise InputError("there is no display: write a file with `ms-slam view --save FILE`")
        self.rr = rerun
        self.env = env
        self.step = 0
        self.stream = rerun.RecordingStream(APPLICATION)
        self.path = path
        if path is not None:  # through memory: Rerun never finishes its own file on a full disk
            self.bytes = rerun.binary_stream(self.stream)
            self.stream.send_blueprint(self._layout())
            return
        try:
            self.stream.spawn(default_blueprint=self._layout())
        except Exception as error:  # any reason that a window cannot be opened
            raise InputError(f"Rerun's viewer cannot be opened: {error}") from error

    def close(self) -> None:
        """Send the remaining data, and write the file.

        Raises:
            OSError: with the name of the file.
        """
        if self.path is not None:
            write_bytes(self.path, self.bytes.read() or b"")
        else:
            self.stream.flush()
        self.stream.disconnect()

    def log(self, planner: Planner | None = None) -> None:
        """Send the current state of the episode."""
        self.stream.set_time("step", sequence=self.step)
        self._cameras()
        self._map()
        self._plans(planner)
        self._measures()
        self.step += 1

    def _send(self, entity: str, what: Any, *more: Any) -> None:
        self.stream.log(entity, what, *more)

    def _cameras(self) -> None:
        rr, episode, K = self.rr, self.env.episode, self.env.intrinsics
        frame = episode.last_frame
        for name, T in (
            ("camera", episode.trajectory_truth[-1]),
            ("estimate", episode.T_world_camera_estimate),
        ):
            self._send(f"world/{name}", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            pinhole = rr.Pinhole(
                image_from_camera=K.matrix, resolution=[K.width, K.height], image_plane_distance=0.2
            )
            self._send(f"world/{name}/image", pinhole)
        self._send("world/camera/image/color", rr.Image(frame.color))
        self._send("depth", rr.DepthImage(frame.depth, meter=1.0))
        for name, path, color in (
            ("true", episode.trajectory_truth, TRUE_COLOR),
            ("estimated", episode.trajectory_estimate, ESTIMATE_COLOR),
        ):
            strip = rr.LineStrips3D([path[:, :3, 3]], colors=[color], radii=0.006)
            self._send(f"world/path/{name}", strip)
        dots, colors = arm_dots(self.env.embodiment, self.env.scene)
        if len(dots):
            self._send("world/arm", rr.Points3D(dots, colors=colors, radii=0.005))

    def _map(self) -> None:
        slam = self.env.slam
        points, colors = slam.surface_points(), slam.surface_colors()
        submap = slam.map_attributes().get("submap")
        if submap is not None and len(np.unique(submap)) > 1:
            colors = colors // 2 + _SUBMAPS[submap % len(_SUBMAPS)] // 2
        every = slice(None, None, 1 + len(points) // _MOST_POINTS)
        self._send(
            "world/map", self.rr.Points3D(points[every], colors=colors[every], radii=_SURFEL_M)
        )

    def _plans(self, planner: Planner | None) -> None:
        rr, episode = self.rr, self.env.episode
        poses = self.env.candidate_poses()
        predicted = episode.predicted_divergences
        labels = None
        if predicted is not None:
            labels = [f"{describe(a)}: {i:.4f}, {d:.4f}" for a, (i, d) in enumerate(predicted)]
        possible = self.env.simulation.action_masks()
        shown = np.where(possible[:, None], [[240, 200, 40]], [[120, 120, 120]])
        candidates = rr.Points3D(
            poses[:, :3, 3], colors=shown, radii=0.008, labels=labels, show_labels=False
        )
        self._send("world/candidates", candidates)
        goal = goal_of(planner)
        if goal is None:
            self._send("world/goal", rr.Clear(recursive=True))
        else:
            here = episode.T_world_camera_estimate[:3, 3]
            arrow = rr.Arrows3D(
                origins=[goal[:3, 3], here],
                vectors=[0.3 * goal[:3, 2], goal[:3, 3] - here],
                colors=[(40, 90, 220), (150, 170, 230)],
            )
            self._send("world/goal", arrow)

    def _measures(self) -> None:
        rr, episode, maxima = self.rr, self.env.episode, self.env.config.targets.maxima
        for name, value, most in zip(
            ("intensity", "depth"), episode.divergence, maxima, strict=True
        ):
            self._send(f"divergence/{name}", rr.Scalars([value]))
            self._send(f"divergence/{name}/maximum", rr.Scalars([most]))
        for name, value in episode.reward_terms.items():
            self._send(f"reward/{name}", rr.Scalars([value]))
        self._send("error/pose_m", rr.Scalars([episode.pose_error]))
        self._send("error/ate_m", rr.Scalars([episode.ate]))
        self._send("mapped/share", rr.Scalars([self.env.coverage.mapped_share]))
        state = "tracked" if episode.tracking_ok else "TRACKING LOST"
        motion = describe(episode.action) if self.step else "start"
        self._send("motion", rr.TextLog(f"{motion}; {state}"))

    def _layout(self) -> Any:
        import rerun.blueprint as rrb

        return rrb.Blueprint(
            rrb.Horizontal(
                rrb.Spatial3DView(origin="world", name="Map and paths"),
                rrb.Vertical(
                    rrb.Spatial2DView(origin="world/camera/image", name="Camera"),
                    rrb.Spatial2DView(origin="depth", name="Depth"),
                ),
                rrb.Vertical(
                    rrb.TimeSeriesView(origin="divergence", name="Divergence against M"),
                    rrb.TimeSeriesView(origin="reward", name="Reward terms"),
                    rrb.TimeSeriesView(origin="error", name="Error, m"),
                    rrb.TextLogView(origin="motion", name="Motions"),
                ),
                column_shares=[3, 2, 2],
            ),
            collapse_panels=True,
        )
