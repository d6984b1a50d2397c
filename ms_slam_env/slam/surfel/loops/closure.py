"""Local loop closure: the part of the map not seen of late is registered with the present one.

ElasticFusion (Whelan et al., RSS 2015, sections IV to VI). Surfels not seen for ``window`` frames
are inactive: frames are neither tracked against them nor fused into them. Where the inactive part
comes into view, it is rendered and the live frame is registered with it, as it was with the active
part before; both poses differ by the drift since. If the registration is good, the deformation
graph takes the active part there while it holds the inactive one, and what is in view is active
again. The paper registers the active part's rendering in place of the live frame; the frame has
no holes, and its noise is common to both poses.

A closed loop makes the estimated pose jump by the drift that it takes back.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.geometry import invert
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.loops.base import Bool, Float64, Int32, LoopClosure
from ms_slam_env.slam.surfel.loops.constraints import (
    Int64,
    VisiblePoints,
    choose_points,
    creation_times,
    surface_constraints,
)
from ms_slam_env.slam.surfel.loops.deformation_graph import (
    FEWEST_NODES,
    Deformation,
    identity,
    sample_graph,
)
from ms_slam_env.slam.surfel.loops.energy import Constraints, optimise
from ms_slam_env.slam.surfel.loops.kernels import (
    Nodes,
    deform_surfels,
    merge,
    reactivate,
)
from ms_slam_env.slam.surfel.mirror import Mirror
from ms_slam_env.slam.surfel.seeds import NUM_SEEDS, tracking_seeds
from ms_slam_env.slam.surfel.splat_renderer import SplatRenderer
from ms_slam_env.slam.surfel.surfel_arrays import EARLIEST, any_time
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.tracking import Tracker, model_stride
from ms_slam_env.slam.surfel.types import LiveFrame
from ms_slam_env.slam.surfel.verdict import make_limits

FEWEST_CONSTRAINTS = 12


@dataclass
class _Past:
    """The tracked frames of one env and their poses, bent by every closure."""

    frames: list[int] = field(default_factory=list)
    poses: list[Float64] = field(default_factory=list)


class DeformationLoopClosure(LoopClosure):
    """Local loops of B envs, closed by embedded deformation."""

    def __init__(self, surfel_map: SurfelMap, config: SurfelConfig, device: str = "cpu") -> None:
        """Close loops of the maps in ``surfel_map`` with ``config.loops``."""
        self.map = surfel_map
        self.config = config.loops
        self.batch = surfel_map.batch
        self.device = device
        intrinsics = surfel_map.intrinsics
        stride = model_stride(intrinsics, config)
        self._tolerance_m = config.fusion_distance_m
        self._stable = config.confidence_threshold
        self._min_cosine = float(np.cos(np.radians(config.fusion_angle_deg)))
        self._inactive = any_time(self.batch, device)
        self._old = surfel_map.model_renderer(stride, self._inactive)
        self._new = surfel_map.model_renderer(stride, surfel_map.active)
        self._tracker = Tracker(self.batch, NUM_SEEDS, intrinsics, config, device, stride)
        self._seeds = np.tile(tracking_seeds(np.eye(4)), (self.batch, 1, 1, 1))
        self._limits = self._make_limits()
        self._poses = Mirror(self.batch, wp.mat44, device)
        self._seen_from = np.full(self.batch, EARLIEST, dtype=np.int32)
        self._last = np.full(self.batch, -1, dtype=np.int32)  # frame that was fused last
        self._past = [_Past() for _ in range(self.batch)]
        self.closures = np.zeros(self.batch, dtype=np.int32)

    def _make_limits(self) -> NDArray[np.void]:
        limits = make_limits(np.ones(self.batch, bool), np.zeros(self.batch, np.int32))
        limits["sigma"] = self.config.sigma
        limits["inliers"] = self.config.inliers
        limits["motion_m"] = self.config.largest_m
        limits["motion_cos"] = np.cos(np.radians(self.config.largest_deg))
        return limits

    def reset(self, env: int) -> None:
        """Forget one env."""
        self._last[env] = -1
        self._past[env] = _Past()
        self.closures[env] = 0

    def select(self, time: Int32, lost: Int32) -> bool:
        """The active surfels, or all while tracking is lost."""
        seen_from = np.where(lost > 0, EARLIEST, self._last - self.config.window)
        seen_from = np.maximum(seen_from, EARLIEST).astype(np.int32)
        changed = not np.array_equal(seen_from, self._seen_from)
        if changed:
            self._seen_from = seen_from
            self.map.active.seen_from.assign(seen_from)
        return changed

    def record(self, poses: Float64, time: Int32, fused: Bool) -> None:
        """Remember the poses of the frames just fused."""
        for env in np.flatnonzero(fused):
            self._last[env] = time[env]
            self._past[env].frames.append(int(time[env]))
            self._past[env].poses.append(poses[env].copy())

    def close(self, live: LiveFrame, poses: Float64, time: Int32, tracked: Bool) -> Bool:
        """Look for loops where it is time to, and close them; see the base class."""
        closed = np.zeros(self.batch, dtype=bool)
        due = tracked & (time > self.config.window) & (time % self.config.interval == 0)
        if not due.any():
            return closed
        due &= self._render_inactive(poses, due)
        if not due.any():
            return closed
        self._tracker.set_frame(live)
        found = self._tracker.align(self._old.view, poses, self._seeds, self._limits)
        for env in np.flatnonzero(due & (found.verdict == 0)):
            closed[env] = self._close(int(env), poses, found.T_world_live[env])
            if closed[env]:
                poses[env] = found.T_world_live[env]
                self._past[env].poses[-1] = poses[env].copy()
                self.closures[env] += 1
        return closed

    def _render_inactive(self, poses: Float64, due: Bool) -> Bool:
        """Render what was not seen of late; which envs (B,) have enough of it in view."""
        self._inactive.seen_to.assign(self._last - self.config.window - 1)
        self._poses.write(poses)
        self._old.cull(self._poses.array)
        pixels = self._old.intrinsics.width * self._old.intrinsics.height
        counts = self._old.visible.count.numpy()
        if not (due & (counts > 0.1 * self.config.coverage * pixels)).any():
            return np.zeros(self.batch, dtype=bool)
        view = self._old.splat()
        covered = view.vertices.numpy()[..., 2] > 0
        return covered.mean(axis=(1, 2)) >= self.config.coverage

    def _close(self, env: int, poses: Float64, corrected: Float64) -> bool:
        """Bend the map of one env so that what is seen from its pose is seen from ``corrected``.

        Returns whether that was believed and done.
        """
        used = int(self.map.surfels.count.numpy()[env])
        order, times = creation_times(self.map.surfels.created[env, :used].numpy())
        time_of = np.empty(used)
        time_of[order] = times
        old, old_depth = self._look(self._old, env, poses, time_of)
        new, new_depth = self._look(self._new, env, poses, time_of)
        pins = self._choose(old, old_depth)
        moved = self._choose(new, np.where(old_depth > 0, new_depth, 0.0))
        if min(len(pins), len(moved)) < FEWEST_CONSTRAINTS or used < FEWEST_NODES:
            return False
        constraints = surface_constraints(
            new.take(moved), old.take(pins), corrected @ invert(poses[env])
        )
        shifts = np.linalg.norm(constraints.targets - constraints.sources, axis=1)
        bends = shifts.max() >= self.config.smallest_m
        if bends:
            positions = self.map.surfels.position[env, :used].numpy()
            count = min(self.config.max_nodes, used // self.config.surfels_per_node)
            graph = sample_graph(positions[order], times, count)
            deformation = optimise(graph, constraints)
            if not self._believed(constraints, deformation):
                return False
            self._apply(env, deformation, time_of)
        seen_from = poses.copy()
        seen_from[env] = corrected
        self._join(env, seen_from)
        return bool(bends)

    def _believed(self, constraints: Constraints, deformation: Deformation) -> bool:
        """Whether the graph could do what the constraints ask."""
        before = constraints.errors(identity(deformation.graph))
        after = constraints.errors(deformation)
        rms = float(np.sqrt(np.mean(after**2)))
        limit = max(
            self.config.smallest_m, self.config.error_share * float(np.sqrt(np.mean(before**2)))
        )
        return rms <= min(self.config.error_m, limit)

    def _look(
        self, renderer: SplatRenderer, env: int, poses: Float64, times: Float64
    ) -> tuple[VisiblePoints, NDArray[np.float32]]:
        """The surfels of one env that a renderer shows, in order of slots, and its depth image."""
        self._poses.write(poses)
        renderer.cull(self._poses.array)
        depth = renderer.splat().vertices.numpy()[env, ..., 2].copy()
        count = int(renderer.visible.count.numpy()[env])
        index = np.sort(renderer.visible.index[env, :count].numpy())
        world = self.map.surfels.position[env].numpy()[index].astype(np.float64)
        camera = (world - poses[env, :3, 3]) @ poses[env, :3, :3]
        return VisiblePoints(camera, world, times[index]), depth

    def _choose(self, points: VisiblePoints, depth: NDArray[np.float32]) -> Int64:
        """Some of the points on a surface, spread over the image."""
        columns = self.config.constraint_columns
        return choose_points(points, self._old.intrinsics, depth, columns, self._tolerance_m)

    def _apply(self, env: int, deformation: Deformation, times: Float64) -> None:
        """Move the surfels and the past poses of one env."""
        graph = deformation.graph
        nodes = Nodes()
        nodes.position = wp.array(graph.positions, dtype=wp.vec3, device=self.device)
        nodes.R = wp.array(deformation.R, dtype=wp.mat33, device=self.device)
        nodes.t = wp.array(deformation.t, dtype=wp.vec3, device=self.device)
        first = graph.first_candidates(times).astype(np.int32)
        wp.launch(
            deform_surfels,
            dim=len(times),
            inputs=[
                self.map.surfels,
                env,
                nodes,
                wp.array(first, dtype=wp.int32, device=self.device),
                graph.window,
            ],
            device=self.device,
        )
        self.map.surfels_moved()
        past = self._past[env]
        moved = deformation.poses(np.stack(past.poses), np.array(past.frames) + 0.5)
        past.poses = list(moved)

    def _join(self, env: int, poses: Float64) -> None:
        """Make one surface of the two parts in view from ``poses``, and both active."""
        self._poses.write(poses)
        self._old.cull(self._poses.array)
        view = self._old.splat()
        visible, surfels = self._old.visible, self.map.surfels
        count = int(visible.count.numpy()[env])
        seen = surfels.seen[env].numpy()[visible.index[env, :count].numpy()]
        self._new.cull(self._poses.array)
        wp.launch(
            merge,
            dim=int(visible.count.numpy()[env]),
            inputs=[
                surfels,
                env,
                visible,
                self._old.camera,
                view.vertices,
                view.normals,
                self._min_cosine,
                self._stable,
            ],
            device=self.device,
        )
        # What was seen about the same time hangs together with what was matched.
        reach = self.config.window // 2
        wp.launch(
            reactivate,
            dim=int(surfels.count.numpy()[env]),
            inputs=[
                surfels,
                env,
                int(np.quantile(seen, 0.1)) - reach,
                int(np.quantile(seen, 0.9)) + reach,
                int(self._last[env]),
            ],
            device=self.device,
        )
        self.map.surfels_moved()

    def trajectory(self, env: int) -> tuple[Int32, Float64]:
        """Tracked frames (N,) and their poses (N, 4, 4), bent by the closures since."""
        past = self._past[env]
        return np.array(past.frames, dtype=np.int32), np.array(past.poses).reshape(-1, 4, 4)

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""
        return {
            "last": self._last.copy(),
            "closures": self.closures.copy(),
            "past": [self.trajectory(env) for env in range(self.batch)],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
        self._last = state["last"].copy()
        self.closures = state["closures"].copy()
        self._past = [
            _Past([int(frame) for frame in frames], list(poses.copy()))
            for frames, poses in state["past"]
        ]
