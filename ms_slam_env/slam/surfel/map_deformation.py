"""Deforms the map of one env so that its present part meets the inactive one; joins them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.slam.shared.rows import Rows, join
from ms_slam_env.slam.slam_backend import Float64
from ms_slam_env.slam.surfel.deformation_graph import (
    FEWEST_NODES,
    Constraints,
    Deformation,
    identity,
    optimise,
    sample_graph,
)
from ms_slam_env.slam.surfel.device import HostDeviceBuffer
from ms_slam_env.slam.surfel.rendering import SplatRenderer
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.surfels import (
    SplatCamera,
    Surfels,
    VisibleList,
    depth_tolerance,
    floor_int,
)

Int64 = NDArray[np.int64]

FEWEST_CONSTRAINTS = 12
NEAREST = wp.constant(5)  # of deformation_graph: NEIGHBOURS that move a point, and the next one


@dataclass(frozen=True)
class VisiblePoints(Rows):
    """Surfels in sight of a camera."""

    camera: Float64  # (N, 3) positions in the camera's frame
    world: Float64  # (N, 3) positions in the world
    times: Float64  # (N,) when they were created, see ``creation_times``


def creation_times(created: NDArray[np.int32]) -> tuple[Int64, Float64]:
    """Order (N,) of surfels by creation, and their times (N,) in frames, in that order.

    Surfels of one frame are spread over it evenly in the order of their slots, which is that of
    the image's rows: neighbours in time are then neighbours in space too, and the first frame,
    which makes a third of a small map, has as many nodes of the graph as it deserves.
    """
    order = np.argsort(created, kind="stable")
    ordered = created[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=-1))  # of every frame's surfels
    counts = np.diff(starts, append=len(ordered))
    places = np.arange(len(ordered)) - np.repeat(starts, counts)
    times = ordered + places / np.repeat(counts, counts)
    return order.astype(np.int64), times.astype(np.float64)


def choose_points(
    points: VisiblePoints,
    intrinsics: Intrinsics,
    depth: NDArray[np.float32],
    columns: int,
    tolerance_m: float,
) -> Int64:
    """One surfel (M,) for each cell of the image, the nearest to its middle.

    Args:
        points: surfels in sight.
        intrinsics: of ``depth``.
        depth: (H, W) metres of the surface that they must lie on; 0 = leave such pixels out.
        columns: number of cells side by side.
        tolerance_m: how far from the surface, at 1 m; grows with depth squared.
    """
    z = points.camera[:, 2]
    place = intrinsics.project(points.camera)
    u, v = np.floor(place + 0.5).astype(np.int64).T
    inside = (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height)
    inside = np.flatnonzero(inside)
    front = depth[v[inside], u[inside]]
    on_surface = np.abs(z[inside] - front) < tolerance_m * (0.7 + 0.3 * front**2)
    usable = inside[(front > 0) & on_surface]
    cells = (place[usable] + 0.5) / (intrinsics.width / columns)
    off_centre = np.linalg.norm(cells - np.floor(cells) - 0.5, axis=1)
    order = np.argsort(off_centre, kind="stable")
    column, row = np.floor(cells[order]).astype(np.int64).T
    _, firsts = np.unique(row * (columns + 1) + column, return_index=True)
    return usable[order[firsts]]


def surface_constraints(
    active: VisiblePoints, inactive: VisiblePoints, correction: Float64
) -> Constraints:
    """Move points of the active part by ``correction`` (4, 4), hold those of the inactive part."""
    targets = transform_points(correction, active.world)
    moves = Constraints(active.world, active.times, targets, np.full(len(targets), np.nan))
    pins = np.full(len(inactive.world), np.nan)
    return join([moves, Constraints(inactive.world, inactive.times, inactive.world, pins)])


def relative_to(
    constraints: Constraints, active: VisiblePoints, inactive: VisiblePoints
) -> Constraints:
    """The moves among ``surface_constraints`` as relative ones, which later loops must respect.

    A target is as old as the nearest pin.
    """
    count = len(active.world)
    targets = constraints.targets[:count]
    _, nearest = cKDTree(inactive.world).query(targets)
    return Constraints(active.world, active.times, targets, inactive.times[nearest])


@wp.struct
class Nodes:
    """A deformation of one map: position (M,), linear part and translation of the nodes."""

    position: wp.array(dtype=wp.vec3)
    R: wp.array(dtype=wp.mat33)
    t: wp.array(dtype=wp.vec3)


@wp.kernel
def deform_surfels(
    surfels: Surfels,
    b: int,
    nodes: Nodes,
    first: wp.array(dtype=wp.int32),  # of each surfel's candidate nodes
    window: int,  # number of candidates
) -> None:
    """Move position and normal of every surfel of env b: ``Deformation.points`` in float32.

    The normal turns with the blend of R, which is close to a rotation; the paper's inverse
    transpose of R is the same for a rotation.
    """
    i = wp.tid()
    p = surfels.position[b, i]
    index = wp.vector(length=NEAREST, dtype=wp.int32)
    distance = wp.vector(length=NEAREST, dtype=wp.float32)
    for k in range(NEAREST):
        distance[k] = 1.0e30
    for candidate in range(window):
        n = first[i] + candidate
        d = wp.length(nodes.position[n] - p)
        place = int(NEAREST)
        while place > 0 and d < distance[place - 1]:
            place -= 1
        k = int(NEAREST) - 1
        while k > place:
            distance[k] = distance[k - 1]
            index[k] = index[k - 1]
            k -= 1
        if place < NEAREST:
            distance[place] = d
            index[place] = n
    per_farthest = 1.0 / wp.max(distance[NEAREST - 1], 1.0e-12)
    total = wp.float32(0.0)
    moved = wp.vec3(0.0, 0.0, 0.0)
    turned = wp.vec3(0.0, 0.0, 0.0)
    normal = surfels.normal[b, i]
    for k in range(NEAREST - 1):
        share = 1.0 - distance[k] * per_farthest
        weight = share * share + 1.0e-6
        n = index[k]
        centre = nodes.position[n]
        total += weight
        moved += weight * (nodes.R[n] * (p - centre) + centre + nodes.t[n])
        turned += weight * (nodes.R[n] * normal)
    surfels.position[b, i] = moved / total
    surfels.normal[b, i] = wp.normalize(turned)


@wp.func
def pixel_of(p: wp.vec3, camera: SplatCamera):
    """Pixel (u, v) of the image nearest to the projection of a point."""
    u = floor_int(camera.focal[0] * p[0] / p[2] + camera.centre[0] + 0.5)
    v = floor_int(camera.focal[1] * p[1] / p[2] + camera.centre[1] + 0.5)
    return wp.vec2i(wp.clamp(u, 0, camera.width - 1), wp.clamp(v, 0, camera.height - 1))


@wp.kernel
def reactivate(surfels: Surfels, b: int, seen_from: int, seen_to: int, now: int) -> None:
    """Count the surfels of env b that were last seen within these frames as seen now."""
    i = wp.tid()
    seen = surfels.seen[b, i]
    if seen >= seen_from and seen <= seen_to:
        surfels.seen[b, i] = now


@wp.kernel
def merge(
    surfels: Surfels,
    b: int,
    visible: VisibleList,  # of the active surfels
    camera: SplatCamera,
    vertices: wp.array3d(dtype=wp.vec3),  # image of the inactive surfels
    normals: wp.array3d(dtype=wp.vec3),
    min_cosine: float,
    stable: float,  # confidence
) -> None:
    """Remove the unstable active surfels of env b that lie on a surface mapped before."""
    j = wp.tid()
    p = visible.position[b, j]
    pixel = pixel_of(p, camera)
    front = vertices[b, pixel[1], pixel[0]][2]
    if front > 0.0 and wp.abs(p[2] - front) < depth_tolerance(camera.tolerance_m, front):
        i = visible.index[b, j]
        alike = wp.dot(visible.normal[b, j], normals[b, pixel[1], pixel[0]]) > min_cosine
        if alike and surfels.confidence[b, i] < stable:
            surfels.confidence[b, i] = 0.0
            wp.atomic_add(surfels.dead, b, 1)


class MapDeformer:
    """Deforms the maps of B envs, one at a time."""

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
        self._poses = HostDeviceBuffer(surfel_map.batch, wp.mat44, device)

    def deform(
        self, env: int, pose: Float64, corrected: Float64, earlier: Constraints
    ) -> tuple[Deformation, Constraints] | None:
        """Take what is seen from ``pose`` to where it is seen from ``corrected``, if acceptable.

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
        old = old.chosen(self._choose(old, old_depth))
        new = new.chosen(self._choose(new, np.where(old_depth > 0, new_depth, 0.0)))
        if min(len(old.world), len(new.world)) < FEWEST_CONSTRAINTS:
            return None
        surface = surface_constraints(new, old, corrected @ invert(pose))
        constraints = join([surface, earlier])
        positions = self.map.surfels.position[env, :used].numpy()
        count = min(self.config.max_nodes, used // self.config.surfels_per_node)
        graph = sample_graph(positions[order], ordered_times, count)
        deformation = optimise(graph, constraints)
        if not self._is_acceptable(constraints, deformation):
            return None
        self._move_surfels(env, deformation, times)
        return deformation, relative_to(surface, new, old).moved_by(deformation)

    def _is_acceptable(self, constraints: Constraints, deformation: Deformation) -> bool:
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
        candidates: Any = wp.array(first, dtype=wp.int32, device=self.device)
        self._launch(deform_surfels, len(times), env, [nodes, candidates, graph.window])
        self.map.surfels_moved()

    def _launch(self, kernel: Any, count: int, env: int, inputs: list[Any]) -> None:
        """Run a kernel on ``count`` surfels of one env."""
        inputs = [self.map.surfels, env, *inputs]
        wp.launch(kernel, dim=count, inputs=inputs, device=self.device)

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
        shown = [active, self._inactive.camera, view.vertices, view.normals]
        rule = [self._min_cosine, self._stable]
        self._launch(merge, int(active.count.numpy()[env]), env, [*shown, *rule])
        reach = self.config.window // 2
        first, last = (int(np.quantile(seen, q)) for q in (0.1, 0.9))
        count = int(self.map.surfels.count.numpy()[env])
        self._launch(reactivate, count, env, [first - reach, last + reach, now])
        self.map.surfels_moved()


def _rms(distances: Float64) -> float:
    return float(np.sqrt(np.mean(distances**2)))
