"""Bends the map of one env so that its present part meets the inactive one, and joins them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.geometry import invert
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.loops.base import Float64
from ms_slam_env.slam.surfel.loops.constraints import (
    Int64,
    VisiblePoints,
    choose_points,
    creation_times,
    relative_to,
    surface_constraints,
)
from ms_slam_env.slam.surfel.loops.deformation_graph import (
    FEWEST_NODES,
    Deformation,
    identity,
    sample_graph,
)
from ms_slam_env.slam.surfel.loops.energy import Constraints, join, optimise
from ms_slam_env.slam.surfel.loops.kernels import Nodes, deform_surfels, merge, reactivate
from ms_slam_env.slam.surfel.mirror import Mirror
from ms_slam_env.slam.surfel.splat_renderer import SplatRenderer
from ms_slam_env.slam.surfel.surfel_map import SurfelMap

FEWEST_CONSTRAINTS = 12


class MapBender:
    """Bends the maps of B envs, one at a time.

    Args:
        surfel_map: the maps.
        inactive: renders the inactive surfels.
        active: renders the active ones.
        config: of the SLAM.
        device: Warp device.
    """

    def __init__(
        self,
        surfel_map: SurfelMap,
        inactive: SplatRenderer,
        active: SplatRenderer,
        config: SurfelConfig,
        device: str,
    ) -> None:
        self.map = surfel_map
        self.config = config.loops
        self.device = device
        self._inactive = inactive
        self._active = active
        self._tolerance_m = config.fusion_distance_m
        self._stable = config.confidence_threshold
        self._min_cosine = float(np.cos(np.radians(config.fusion_angle_deg)))
        self._poses = Mirror(surfel_map.batch, wp.mat44, device)

    def bend(
        self, env: int, pose: Float64, corrected: Float64, earlier: Constraints
    ) -> tuple[Deformation, Constraints] | None:
        """Take what is seen from ``pose`` to where it is seen from ``corrected``, if believable.

        Args:
            env: whose map.
            pose: (4, 4) of the camera in the active part.
            corrected: (4, 4) the same in the inactive part.
            earlier: relative constraints of the loops closed before.

        Returns:
            The deformation done, and the relative constraints of this loop, at their new places;
            None if the map is as it was.
        """
        used = int(self.map.surfels.count.numpy()[env])
        if used < FEWEST_NODES:
            return None
        order, ordered_times = creation_times(self.map.surfels.created[env, :used].numpy())
        times = np.empty(used)
        times[order] = ordered_times
        old, old_depth = self._look(self._inactive, env, corrected, times)
        new, new_depth = self._look(self._active, env, pose, times)
        old = old.take(self._choose(old, old_depth))
        new = new.take(self._choose(new, np.where(old_depth > 0, new_depth, 0.0)))
        if min(len(old.world), len(new.world)) < FEWEST_CONSTRAINTS:
            return None
        surface = surface_constraints(new, old, corrected @ invert(pose))
        constraints = join([surface, earlier])
        positions = self.map.surfels.position[env, :used].numpy()
        count = min(self.config.max_nodes, used // self.config.surfels_per_node)
        graph = sample_graph(positions[order], ordered_times, count)
        deformation = optimise(graph, constraints)
        if not self._is_believable(constraints, deformation):
            return None
        self._move_surfels(env, deformation, times)
        return deformation, relative_to(surface, new, old).moved_by(deformation)

    def _is_believable(self, constraints: Constraints, deformation: Deformation) -> bool:
        """Whether the graph could do what the constraints ask."""
        before = _rms(constraints.errors(identity(deformation.graph)))
        after = _rms(constraints.errors(deformation))
        allowed = max(self.config.smallest_m, self.config.error_share * before)
        return after <= min(self.config.error_m, allowed)

    def _look(
        self, renderer: SplatRenderer, env: int, pose: Float64, times: Float64
    ) -> tuple[VisiblePoints, NDArray[np.float32]]:
        """The surfels of one env that a renderer shows, in order of slots, and its depth image."""
        self._cull(renderer, pose)
        depth = renderer.splat().vertices.numpy()[env, ..., 2].copy()
        index = np.sort(self._visible(renderer, env))
        world = self.map.surfels.position[env].numpy()[index].astype(np.float64)
        camera = (world - pose[:3, 3]) @ pose[:3, :3]
        return VisiblePoints(camera, world, times[index]), depth

    def _cull(self, renderer: SplatRenderer, pose: Float64) -> None:
        self._poses.write(np.broadcast_to(pose, (self.map.batch, 4, 4)))
        renderer.cull(self._poses.array)

    def _visible(self, renderer: SplatRenderer, env: int) -> NDArray[np.int32]:
        """Slots of the surfels that the last cull listed."""
        count = int(renderer.visible.count.numpy()[env])
        return renderer.visible.index[env, :count].numpy() if count else np.zeros(0, np.int32)

    def _choose(self, points: VisiblePoints, depth: NDArray[np.float32]) -> Int64:
        """Some of the points on a surface, spread over the image."""
        columns = self.config.constraint_columns
        return choose_points(points, self._inactive.intrinsics, depth, columns, self._tolerance_m)

    def _move_surfels(self, env: int, deformation: Deformation, times: Float64) -> None:
        graph = deformation.graph
        nodes = Nodes()
        nodes.position = wp.array(graph.positions, dtype=wp.vec3, device=self.device)
        nodes.R = wp.array(deformation.R, dtype=wp.mat33, device=self.device)
        nodes.t = wp.array(deformation.t, dtype=wp.vec3, device=self.device)
        first = graph.first_candidates(times).astype(np.int32)
        first_device: Any = wp.array(first, dtype=wp.int32, device=self.device)
        wp.launch(
            deform_surfels,
            dim=len(times),
            inputs=[self.map.surfels, env, nodes, first_device, graph.window],
            device=self.device,
        )
        self.map.surfels_moved()

    def join_parts(self, env: int, pose: Float64, now: int) -> None:
        """Make one surface of both parts in view from ``pose`` (4, 4), and the old one active.

        Surfels seen about the same time as those in view come along: they hang together.
        """
        self._cull(self._inactive, pose)
        view = self._inactive.splat()
        listed = self._visible(self._inactive, env)
        if not len(listed):
            return
        seen = self.map.surfels.seen[env].numpy()[listed]
        self._cull(self._active, pose)
        active = self._active.visible
        wp.launch(
            merge,
            dim=int(active.count.numpy()[env]),
            inputs=[
                self.map.surfels,
                env,
                active,
                self._inactive.camera,
                view.vertices,
                view.normals,
                self._min_cosine,
                self._stable,
            ],
            device=self.device,
        )
        reach = self.config.window // 2
        first, last = (int(np.quantile(seen, q)) for q in (0.1, 0.9))
        wp.launch(
            reactivate,
            dim=int(self.map.surfels.count.numpy()[env]),
            inputs=[self.map.surfels, env, first - reach, last + reach, now],
            device=self.device,
        )
        self.map.surfels_moved()


def _rms(distances: Float64) -> float:
    return float(np.sqrt(np.mean(distances**2)))
